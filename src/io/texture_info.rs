//! Where the JSON of a glTF material names textures and extensions.
//!
//! A textureInfo is an object with an integer `index` under a key that ends with "Texture"
//! (`baseColorTexture`, `clearcoatNormalTexture`, …), in extensions too. What is in `extras`
//! belongs to applications and is not looked at.

use std::collections::BTreeSet;

use serde_json::{Map, Value};

const EXTRAS: &str = "extras";

/// The texture that an entry of an object names, if it is a textureInfo.
fn texture_of(key: &str, value: &Value) -> Option<u64> {
    if key.to_ascii_lowercase().ends_with("texture") { value.get("index")?.as_u64() } else { None }
}

/// How many textureInfos there are.
pub(super) fn count(value: &Value) -> usize {
    match value {
        Value::Array(list) => list.iter().map(count).sum(),
        Value::Object(map) => map
            .iter()
            .filter(|(key, _)| *key != EXTRAS)
            .map(|(key, value)| usize::from(texture_of(key, value).is_some()) + count(value))
            .sum(),
        _ => 0,
    }
}

/// Removes the textureInfos of textures that `keep` denies, and lets it change the others.
pub(super) fn retain(
    value: &mut Value,
    keep: &mut dyn FnMut(u64, &mut Map<String, Value>) -> bool,
) {
    match value {
        Value::Array(list) => list.iter_mut().for_each(|value| retain(value, keep)),
        Value::Object(map) => map.retain(|key, value| {
            if key == EXTRAS {
                return true;
            }
            let is_kept = match (texture_of(key, value), &mut *value) {
                (Some(texture), Value::Object(info)) => keep(texture, info),
                _ => true,
            };
            retain(value, keep);
            is_kept
        }),
        _ => {}
    }
}

/// Adds the names of all extensions in use.
pub(super) fn extensions(value: &Value, names: &mut BTreeSet<String>) {
    match value {
        Value::Array(list) => list.iter().for_each(|value| extensions(value, names)),
        Value::Object(map) => {
            for (key, value) in map.iter().filter(|(key, _)| *key != EXTRAS) {
                if let (true, Value::Object(of_object)) = (key == "extensions", value) {
                    names.extend(of_object.keys().cloned());
                }
                extensions(value, names);
            }
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn material() -> Value {
        json!({
            "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } },
            "normalTexture": { "index": 9, "scale": 2 },
            "extensions": { "KHR_materials_x": {
                "xTexture": { "index": 1, "extensions": { "KHR_texture_transform": {} } },
                "yTexture": { "index": 9 }, "zTexture": 3 } },
            "extras": { "someTexture": { "index": 9 }, "extensions": { "NONE": {} } },
        })
    }

    #[test]
    fn textures_and_extensions_are_found_at_every_depth() {
        assert_eq!(count(&material()), 4);
        let mut names = BTreeSet::new();
        extensions(&material(), &mut names);
        assert_eq!(Vec::from_iter(names), ["KHR_materials_x", "KHR_texture_transform"]);
    }

    #[test]
    fn textures_that_are_not_kept_go() {
        let mut found = material();
        retain(&mut found, &mut |texture, info| {
            info.insert("texCoord".to_owned(), 1.into());
            texture < 2
        });
        let mut expected = material();
        let object = |value: &mut Value| value.as_object_mut().unwrap().clone();
        let mut top = object(&mut expected);
        top.remove("normalTexture");
        expected = Value::Object(top);
        let extension = expected.pointer_mut("/extensions/KHR_materials_x").unwrap();
        extension.as_object_mut().unwrap().remove("yTexture");
        extension["xTexture"]["texCoord"] = 1.into();
        expected["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1.into();
        assert_eq!(found, expected);
    }
}
