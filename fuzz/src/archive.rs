//! Archives: seeds, and mutations that leave the archive whole around a damaged member.

use crate::{Random, any_bytes, glb, obj_seeds};

/// An OBJ with its materials and their image; the glTF of a square with its buffer beside it.
fn members() -> [Vec<(&'static str, Vec<u8>)>; 2] {
    let mtl = b"newmtl a\nKd 1 0 0\nd .5\nmap_Kd -s 2 -o .5 .5 -clamp on a.png\n".to_vec();
    let obj = obj_seeds().pop().unwrap_or_default();
    let (gltf, bin) = glb::apart();
    [
        vec![("m/a.obj", obj), ("a", mtl), ("a.png", glb::png())],
        vec![("a.gltf", gltf), ("a.bin", bin)],
    ]
}

pub fn seeds() -> Vec<Vec<u8>> {
    members().iter().map(|files| pack(files)).collect()
}

/// Changes of any bytes, or of one member, whose checksum is right.
pub fn change(bytes: &mut Vec<u8>, random: &mut Random) {
    if random.below(2) == 0 {
        return any_bytes(bytes, random);
    }
    let [obj, gltf] = members();
    let mut files = if random.below(2) == 0 { obj } else { gltf };
    let file = random.below(files.len());
    any_bytes(&mut files[file].1, random);
    *bytes = pack(&files);
}

/// Members that are stored, not compressed.
fn pack(members: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, bytes) in members {
        let (at, n) = (out.len() as u32, bytes.len() as u32);
        // Version, flags, method, time, date; what both headers have.
        let mut common = [20_u16, 0, 0, 0, 0].map(u16::to_le_bytes).concat();
        common.extend([crc32(bytes), n, n].map(u32::to_le_bytes).concat());
        common.extend([name.len() as u16, 0].map(u16::to_le_bytes).concat());
        out.extend(b"PK\x03\x04");
        out.extend(&common);
        out.extend(name.as_bytes());
        out.extend(bytes);
        directory.extend(b"PK\x01\x02\x14\0");
        directory.extend(common);
        directory.extend([0; 10]);
        directory.extend(at.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let (at, n) = (out.len() as u32, members.len() as u16);
    out.extend(&directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    out.extend([n, n].map(u16::to_le_bytes).concat());
    out.extend([directory.len() as u32, at].map(u32::to_le_bytes).concat());
    out.extend([0, 0]);
    out
}

pub fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, bit: u32| (crc >> 1) ^ (0xedb8_8320 & 0_u32.wrapping_sub(bit & 1));
    let shift = |crc: u32| (0..8).fold(crc, |crc, _| step(crc, crc));
    !bytes.iter().fold(u32::MAX, |crc, byte| shift(crc ^ u32::from(*byte)))
}
