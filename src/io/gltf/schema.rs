//! From JSON to the schema of the `gltf` crate.
//!
//! The schema refuses whole files for parts that are legal, or that nobody reads: channels of animations that have
//! no node, scenes without nodes, cameras without a lens, and integers with a decimal point. A file that it refuses
//! is read again with such parts mended; what is refused then is wrong. Most files are read once, and as they are.

use gltf::json::{Error, Root, deserialize};
use serde::Deserialize;
use serde_json::{Value, json};

use super::{IoError, REMEDY, Source, compressed, draco};

/// What the schema drops: materials are kept word for word; textures, buffer views and primitives
/// have extensions.
#[derive(Default, Deserialize)]
#[serde(default)]
pub(super) struct Verbatim {
    pub(super) materials: Vec<Value>,
    pub(super) textures: Vec<Value>,
    #[serde(rename = "bufferViews")]
    pub(super) buffer_views: Vec<compressed::Carrier>,
    pub(super) meshes: Vec<draco::Carrier>,
}

/// Parses the document, and what the schema drops of it.
pub(super) fn parse(source: &Source<'_>, json: &[u8]) -> Result<(Root, Verbatim), IoError> {
    let located = |error: &Error| {
        let place = format!("JSON, line {} column {}", error.line(), error.column());
        source.malformed(place, error.to_string(), REMEDY)
    };
    let refusal = match of_text(json) {
        Ok(parsed) => return Ok(parsed),
        Err(error) if error.is_data() => error,
        Err(error) => return Err(located(&error)),
    };
    let mut document: Value = deserialize::from_slice(json).map_err(|error| located(&error))?;
    mend(&mut document);
    of_value(document).map_err(|error| {
        // Only the text has places. What is refused now need not be what was refused there.
        let text = error.to_string();
        let is_same = refusal.to_string().starts_with(&text);
        if is_same { located(&refusal) } else { source.malformed("JSON", text, REMEDY) }
    })
}

fn of_text(json: &[u8]) -> Result<(Root, Verbatim), Error> {
    Ok((deserialize::from_slice(json)?, deserialize::from_slice(json)?))
}

fn of_value(document: Value) -> Result<(Root, Verbatim), Error> {
    let verbatim = Verbatim::deserialize(&document)?;
    Ok((deserialize::from_value(document)?, verbatim))
}

type Mend = fn(&mut Value);

/// Lists of the document, and what is done to each of their entries.
const MENDS: [(&str, Mend); 3] = [
    // These two are counted, not read.
    ("animations", |animation| *animation = json!({ "channels": [], "samplers": [] })),
    ("cameras", |camera| *camera = json!({ "type": "perspective" })),
    ("scenes", |scene| {
        if let Value::Object(scene) = scene {
            scene.entry("nodes").or_insert_with(|| json!([]));
        }
    }),
];

fn mend(document: &mut Value) {
    for (key, mend) in MENDS {
        let list = document.get_mut(key).and_then(Value::as_array_mut);
        list.into_iter().flatten().for_each(mend);
    }
    drop_points(document);
}

/// Writes `3.0` as `3`, which is the same in JSON; not in what belongs to applications.
fn drop_points(value: &mut Value) {
    /// Above it not every integer has a floating-point number.
    const MOST: f64 = (1_u64 << 53) as f64;
    match value {
        Value::Array(list) => list.iter_mut().for_each(drop_points),
        Value::Object(map) => {
            map.iter_mut().filter(|(key, _)| *key != "extras").for_each(|(_, v)| drop_points(v));
        }
        Value::Number(number) if number.is_f64() => {
            let whole = number.as_f64().filter(|x| x.fract() == 0.0 && (0.0..=MOST).contains(x));
            if let Some(whole) = whole {
                *value = (whole as u64).into();
            }
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_go_where_nothing_follows() {
        let mut value = json!({
            "count": 642.0, "matrix": [1.0, -1.0, 0.5, 1e300], "extras": { "n": 2.0 }, "name": "3.0",
        });
        drop_points(&mut value);
        let text = r#"{"count":642,"matrix":[1,-1.0,0.5,1e300],"extras":{"n":2.0},"name":"3.0"}"#;
        let expected: Value = serde_json::from_str(text).unwrap();
        assert_eq!(value, expected);
    }
}
