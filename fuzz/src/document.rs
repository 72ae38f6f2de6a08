//! Mutations of glTF that leave whole what is around them, so that they reach what reads the inside:
//! a file whose length is wrong is turned away at its first line.

use serde_json::{Value, json};

use crate::{EDGES, Random, any_bytes, archive::crc32, edit};

/// Changes of a GLB: of any of its bytes, or of document and binary chunk apart.
pub fn change_glb(bytes: &mut Vec<u8>, random: &mut Random) {
    match split(bytes).filter(|_| random.below(4) != 0) {
        None => any_bytes(bytes, random),
        Some((mut document, mut bin)) => {
            let n_bytes = bin.len();
            for _ in 0..=random.below(4) {
                if random.below(2) == 0 || bin.is_empty() {
                    edit_value(&mut document, random);
                } else {
                    edit(&mut bin, random);
                }
            }
            bin.resize(n_bytes, 0);
            if random.below(2) == 0 {
                mend_png(&mut bin);
            }
            *bytes = pack(&document, &bin);
        }
    }
}

/// Changes of a glTF: of any of its bytes, or of its values.
pub fn change_gltf(bytes: &mut Vec<u8>, random: &mut Random) {
    match serde_json::from_slice(bytes).ok().filter(|_| random.below(2) == 0) {
        None => any_bytes(bytes, random),
        Some(mut document) => {
            (0..=random.below(4)).for_each(|_| edit_value(&mut document, random));
            *bytes = document.to_string().into_bytes();
        }
    }
}

/// Document and binary chunk, which may be empty.
fn split(bytes: &[u8]) -> Option<(Value, Vec<u8>)> {
    let n = u32::from_le_bytes(*bytes.get(12..)?.first_chunk()?) as usize;
    let document = serde_json::from_slice(bytes.get(20..20 + n)?).ok()?;
    Some((document, bytes.get(28 + n..).unwrap_or_default().to_vec()))
}

pub fn pack(document: &Value, bin: &[u8]) -> Vec<u8> {
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let word = |n: usize| (n as u32).to_le_bytes();
    let length = 28 + text.len() + bin.len();
    let mut out = [&b"glTF\x02\0\0\0"[..], &word(length), &word(text.len()), b"JSON"].concat();
    out.extend(text);
    out.extend([&word(bin.len())[..], b"BIN\0", bin].concat());
    out
}

/// One value becomes another, or goes, or one more is there.
fn edit_value(document: &mut Value, random: &mut Random) {
    let mut n_values = 0;
    visit(document, &mut |_| {
        n_values += 1;
        false
    });
    let (from, to) = (random.below(n_values), random.below(n_values));
    let mut copy = Value::Null;
    at(document, from, &mut |value| copy = value.clone());
    at(document, to, &mut |value| match (random.below(8), value) {
        (0, value) => *value = copy.clone(),
        (1, Value::Array(list)) => list.push(copy.clone()),
        (2, Value::Array(list)) => drop(list.pop()),
        (1 | 2, Value::Object(map)) => {
            let key = map.keys().nth(random.below(map.len())).cloned();
            key.and_then(|key| map.remove(&key));
        }
        (3, value) => *value = json!([null, "", [], {}, true, "a.png"])[random.below(6)].take(),
        (_, Value::Number(number)) => *number = a_number(number, random),
        (_, Value::Bool(is)) => *is = !*is,
        _ => {}
    });
}

fn a_number(number: &serde_json::Number, random: &mut Random) -> serde_json::Number {
    let near = number.as_i64().unwrap_or(0).wrapping_add(random.below(9) as i64 - 4);
    let real = [-0.0, 0.5, -1e-30, 3e38, 1e300][random.below(5)];
    match random.below(4) {
        0 => EDGES[random.below(EDGES.len())].into(),
        1 => (5_120 + random.below(8)).into(),
        2 => serde_json::Number::from_f64(real).unwrap_or(0.into()),
        _ => near.into(),
    }
}

/// Calls with the `index`-th value, in the order of the document.
fn at(document: &mut Value, index: usize, call: &mut dyn FnMut(&mut Value)) {
    let mut left = index;
    visit(document, &mut |value| {
        if left == 0 {
            call(value);
            return true;
        }
        left -= 1;
        false
    });
}

/// Calls with each value until the call says that it is done.
fn visit(value: &mut Value, call: &mut dyn FnMut(&mut Value) -> bool) -> bool {
    call(value)
        || match value {
            Value::Array(list) => list.iter_mut().any(|below| visit(below, call)),
            Value::Object(map) => map.values_mut().any(|below| visit(below, call)),
            _ => false,
        }
}

/// Right checksums for the first PNG image.
fn mend_png(bin: &mut [u8]) {
    let Some(start) = bin.windows(4).position(|four| four == b"\x89PNG") else { return };
    let mut rest = bin.get_mut(start + 8..).unwrap_or_default();
    while let Some(length) = rest.first_chunk() {
        let end = 8_usize.saturating_add(u32::from_be_bytes(*length) as usize);
        if end > rest.len().saturating_sub(4) {
            break;
        }
        let (chunk, after) = rest.split_at_mut(end);
        after[..4].copy_from_slice(&crc32(&chunk[4..]).to_be_bytes());
        rest = &mut after[4..];
    }
}
