//! The file `progressive.lkpm`: the coarsest mesh, then vertex splits from coarse to fine.
//!
//! | part | bytes |
//! |---|---|
//! | magic | `LKPM` |
//! | version | u32, little-endian, as all that follow: 1 |
//! | header length, header CRC-32 | u32, u32 |
//! | header | JSON: [`Header`], with the length and CRC-32 of every block |
//! | base block | zstd: the coarsest mesh, by the ids of the original |
//! | record blocks | zstd, `RECORDS_PER_BLOCK` records each, last collapse first |
//!
//! A record is a collapse as `codec` writes it, but `to` is zero and the new wedge values are
//! left out (both are known: `keep` stands at `to`), followed by the values of the wedges that
//! appear with the split: uint count; each uint id difference and f32 values. A reader that stops
//! after any block has a valid coarser model.

use std::io::Read;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{
    bytes::{CodecError, Cursor, put_uint, put_vec3},
    codec,
    replay::Level,
};
use crate::mesh::{AttributeLayer, Collapse, Material, Mesh, Semantic};

const MAGIC: &[u8; 4] = b"LKPM";
const VERSION: u32 = 1;
const RECORDS_PER_BLOCK: usize = 4096;
/// zstd level: 3 is the library's default, compression is not where the time goes.
const ZSTD_LEVEL: i32 = 3;
/// No real mesh needs less than a sixteenth of a byte for a vertex or triangle; a header that claims
/// more slots than that is refused before anything is allocated for them.
const MAX_SLOTS_PER_BYTE: usize = 16;

/// A named level of the file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LevelEntry {
    /// Such as `lod-0`.
    pub name: String,
    /// Triangles.
    pub faces: usize,
    /// Whether collapse records alone lead to it.
    pub exact: bool,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Block {
    bytes: usize,
    raw_bytes: usize,
    crc32: u32,
    records: usize,
    /// Triangles after the block's splits.
    faces: usize,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Header {
    producer: String,
    vertices: usize,
    faces: usize,
    wedges: usize,
    records: usize,
    has_face_materials: bool,
    layers: Vec<(Semantic, usize)>,
    materials: Vec<Material>,
    levels: Vec<LevelEntry>,
    /// The base, then the record blocks.
    blocks: Vec<Block>,
}

/// Writes the file of an original and the collapses made on it, in the order they were made.
/// `levels` names some of the triangle counts on the way.
pub fn write(
    original: &Mesh,
    records: &[Collapse],
    levels: &[(String, usize)],
) -> Result<Vec<u8>, CodecError> {
    let mut level = Level::finest(original);
    for r in records {
        level.collapse(r)?;
    }
    let mut is_dropped = vec![false; original.positions.len()];
    records.iter().for_each(|r| is_dropped[r.drop.index()] = true);
    let mut known = vec![false; level.mesh.n_wedges()];
    let base = encode_base(&level, &is_dropped, &mut known);

    let mut faces = level.n_faces();
    let mut blocks = vec![pack(&base, 0, faces)?];
    for chunk in records.rchunks(RECORDS_PER_BLOCK) {
        let mut raw = Vec::with_capacity(chunk.len() * 128);
        for r in chunk.iter().rev() {
            encode_split(r, &level.mesh, &mut known, &mut raw);
            faces += r.removed.len();
        }
        blocks.push(pack(&raw, chunk.len(), faces)?);
    }
    let header = Header {
        producer: format!("lookalike {}", env!("CARGO_PKG_VERSION")),
        vertices: original.positions.len(),
        faces: original.faces.len(),
        wedges: level.mesh.n_wedges(),
        records: records.len(),
        has_face_materials: !original.face_materials.is_empty(),
        layers: original.layers.iter().map(|l| (l.semantic, l.width)).collect(),
        materials: original.materials.clone(),
        levels: levels.iter().map(|l| LevelEntry { name: l.0.clone(), faces: l.1, exact: true }).collect(),
        blocks: blocks.iter().map(|b| b.0.clone()).collect(),
    };
    let json = serde_json::to_vec(&header).map_err(|e| header_fault(&e.to_string()))?;
    let mut out = MAGIC.to_vec();
    for word in [VERSION, json.len() as u32, crc32fast::hash(&json)] {
        out.extend_from_slice(&word.to_le_bytes());
    }
    out.extend_from_slice(&json);
    blocks.iter().for_each(|b| out.extend_from_slice(&b.1));
    Ok(out)
}

fn header_fault(problem: &str) -> CodecError {
    CodecError::Malformed { what: "progressive mesh header", problem: problem.into() }
}

fn pack(raw: &[u8], records: usize, faces: usize) -> Result<(Block, Vec<u8>), CodecError> {
    let packed = zstd::bulk::compress(raw, ZSTD_LEVEL)
        .map_err(|e| CodecError::Malformed { what: "block", problem: e.to_string() })?;
    let crc32 = crc32fast::hash(&packed);
    let block = Block { bytes: packed.len(), raw_bytes: raw.len(), crc32, records, faces };
    Ok((block, packed))
}

fn encode_base(level: &Level, is_dropped: &[bool], known: &mut [bool]) -> Vec<u8> {
    let mesh = &level.mesh;
    let mut out = Vec::new();
    mesh.face_materials.iter().for_each(|m| put_uint(&mut out, u64::from(*m)));
    put_uint(&mut out, level.n_faces() as u64);
    let mut last = 0;
    for (f, _) in level.alive.iter().enumerate().filter(|(_, alive)| **alive) {
        put_uint(&mut out, (f - last) as u64);
        last = f;
        mesh.faces[f].iter().for_each(|v| put_uint(&mut out, u64::from(*v)));
        if let Some(wedges) = mesh.face_wedges.get(f) {
            wedges.iter().for_each(|w| put_uint(&mut out, u64::from(*w)));
        }
    }
    is_dropped.iter().for_each(|d| out.push(u8::from(*d)));
    for (p, _) in mesh.positions.iter().zip(is_dropped).filter(|(_, dropped)| !**dropped) {
        put_vec3(&mut out, *p);
    }
    let used = level.alive.iter().zip(&mesh.face_wedges).filter(|(alive, _)| **alive);
    put_wedges(used.flat_map(|(_, w)| *w), mesh, known, &mut out);
    out
}

/// Appends the values of those wedges that a reader does not know yet.
fn put_wedges(ids: impl Iterator<Item = u32>, mesh: &Mesh, known: &mut [bool], out: &mut Vec<u8>) {
    let mut fresh: Vec<u32> =
        ids.filter(|w| !std::mem::replace(&mut known[*w as usize], true)).collect();
    fresh.sort_unstable();
    put_uint(out, fresh.len() as u64);
    let mut last = 0;
    for w in fresh {
        put_uint(out, u64::from(w - last));
        last = w;
        for layer in &mesh.layers {
            let at = w as usize * layer.width;
            let values = &layer.values[at..at + layer.width];
            values.iter().for_each(|v| out.extend_from_slice(&v.to_bits().to_le_bytes()));
        }
    }
}

fn encode_split(r: &Collapse, mesh: &Mesh, known: &mut [bool], out: &mut Vec<u8>) {
    let stored = Collapse { to: DVec3::ZERO, new_wedges: Vec::new(), ..r.clone() };
    codec::encode(&stored, out);
    if !mesh.layers.is_empty() {
        let removed = r.removed.iter().flat_map(|f| f.wedges);
        let ids = removed.chain(r.rewedged.iter().map(|w| w.from)).map(|w| w.0);
        put_wedges(ids, mesh, known, out);
    }
}

/// An opened file.
pub struct Reader<'a> {
    header: Header,
    /// Bytes of each block.
    blocks: Vec<&'a [u8]>,
}

impl<'a> Reader<'a> {
    /// Opens a file; checks the header, not yet the blocks.
    pub fn open(bytes: &'a [u8]) -> Result<Self, CodecError> {
        let mut c = Cursor::new(bytes, "progressive mesh");
        if c.array::<4>()? != *MAGIC {
            return Err(header_fault("it does not begin with `LKPM`"));
        }
        let found = u32::from_le_bytes(c.array()?);
        if found != VERSION {
            return Err(CodecError::Version { found, known: VERSION });
        }
        let (len, crc) = (u32::from_le_bytes(c.array()?), u32::from_le_bytes(c.array()?));
        let json = c.take(len as usize)?;
        if crc32fast::hash(json) != crc {
            return Err(CodecError::Checksum { what: "progressive mesh header" });
        }
        let header: Header = serde_json::from_slice(json).map_err(|e| header_fault(&e.to_string()))?;
        let most = bytes.len().saturating_mul(MAX_SLOTS_PER_BYTE);
        let widths: usize = header.layers.iter().map(|l| l.1.min(64)).sum();
        if header.vertices.max(header.faces).max(header.wedges.saturating_mul(widths)) > most {
            return Err(header_fault("it claims more than the file can hold"));
        }
        let blocks = header.blocks.iter().map(|b| c.take(b.bytes)).collect::<Result<_, _>>()?;
        Ok(Self { header, blocks })
    }

    /// Named levels.
    pub fn levels(&self) -> &[LevelEntry] {
        &self.header.levels
    }

    /// Triangles of the coarsest level and of the original.
    pub fn face_range(&self) -> (usize, usize) {
        (self.header.blocks.first().map_or(0, |b| b.faces), self.header.faces)
    }

    /// Collapses recorded.
    pub fn n_records(&self) -> usize {
        self.header.records
    }

    /// The level with the most triangles, but at most `target`. Reads no further than it must.
    pub fn extract(&self, target: usize) -> Result<Mesh, CodecError> {
        let mut level = self.coarsest()?;
        if level.n_faces() > target {
            return Err(CodecError::Malformed {
                what: "level",
                problem: format!(
                    "{target} triangles were asked for, the coarsest level has {}: ask for at least \
                     that",
                    level.n_faces()
                ),
            });
        }
        self.refine(&mut level, |level, split| level.n_faces() + split.removed.len() <= target)?;
        Ok(level.to_mesh())
    }

    /// The coarsest level.
    pub fn coarsest(&self) -> Result<Level, CodecError> {
        let raw = self.unpack(0)?;
        decode_base(&self.header, &mut Cursor::new(&raw, "base mesh"))
    }

    /// Splits `level`, which must be the coarsest, as long as `go_on` agrees with the next split.
    /// Returns the splits made, coarse to fine, each with `to` and its new wedges filled in.
    pub fn refine(
        &self,
        level: &mut Level,
        mut go_on: impl FnMut(&Level, &Collapse) -> bool,
    ) -> Result<Vec<Collapse>, CodecError> {
        let mut made = Vec::new();
        for block in 1..self.blocks.len() {
            let raw = self.unpack(block)?;
            let mut c = Cursor::new(&raw, "record block");
            for _ in 0..self.header.blocks[block].records {
                let split = self.decode_split(&mut c, level)?;
                if !go_on(level, &split) {
                    return Ok(made);
                }
                level.split(&split)?;
                made.push(split);
            }
        }
        Ok(made)
    }

    fn decode_split(&self, c: &mut Cursor<'_>, level: &mut Level) -> Result<Collapse, CodecError> {
        let mut split = codec::decode(c)?;
        let position = level.mesh.positions.get(split.keep.index()).copied();
        split.to = position.ok_or_else(|| c.malformed("vertex id out of range"))?;
        if !self.header.layers.is_empty() {
            read_wedges(c, &mut level.mesh)?;
            let news = split.rewedged.iter().map(|w| w.to.0).max();
            for w in news.map_or(0..0, |last| split.first_new_wedge.0..last.saturating_add(1)) {
                for layer in &level.mesh.layers {
                    let at = w as usize * layer.width;
                    let values = layer.values.get(at..at + layer.width);
                    let values = values.ok_or_else(|| c.malformed("wedge id out of range"))?;
                    split.new_wedges.extend_from_slice(values);
                }
            }
        }
        Ok(split)
    }

    fn unpack(&self, block: usize) -> Result<Vec<u8>, CodecError> {
        let (Some(entry), Some(packed)) = (self.header.blocks.get(block), self.blocks.get(block))
        else {
            return Err(header_fault("it names no base mesh"));
        };
        if crc32fast::hash(packed) != entry.crc32 {
            return Err(CodecError::Checksum { what: "block" });
        }
        let fault = |e: std::io::Error| CodecError::Malformed { what: "block", problem: e.to_string() };
        let mut raw = Vec::new();
        let decoder = zstd::Decoder::new(*packed).map_err(fault)?;
        decoder.take(entry.raw_bytes as u64).read_to_end(&mut raw).map_err(fault)?;
        Ok(raw)
    }
}

fn decode_base(h: &Header, c: &mut Cursor<'_>) -> Result<Level, CodecError> {
    let mut mesh = Mesh {
        positions: vec![DVec3::ZERO; h.vertices],
        faces: vec![[0; 3]; h.faces],
        materials: h.materials.clone(),
        ..Mesh::default()
    };
    let layer = |&(semantic, width): &(Semantic, usize)| AttributeLayer {
        semantic,
        width,
        values: vec![0.0; h.wedges.saturating_mul(width)],
    };
    mesh.layers = h.layers.iter().map(layer).collect();
    if h.has_face_materials {
        mesh.face_materials = (0..h.faces).map(|_| c.id()).collect::<Result<_, _>>()?;
    }
    if !mesh.layers.is_empty() {
        mesh.face_wedges = vec![[0; 3]; h.faces];
    }
    let mut alive = vec![false; h.faces];
    let mut f = 0_usize;
    for _ in 0..c.count(4)? {
        f = f.saturating_add(c.id()? as usize);
        let Some(slot) = alive.get_mut(f) else { return Err(c.malformed("face id out of range")) };
        *slot = true;
        mesh.faces[f] = corner_ids(c, h.vertices)?;
        if !mesh.layers.is_empty() {
            mesh.face_wedges[f] = corner_ids(c, h.wedges)?;
        }
    }
    // A flag for every vertex says whether a split will place it.
    let is_dropped = c.take(h.vertices)?;
    for (p, _) in mesh.positions.iter_mut().zip(is_dropped).filter(|(_, d)| **d == 0) {
        *p = c.vec3()?;
    }
    read_wedges(c, &mut mesh)?;
    Ok(Level::new(mesh, alive))
}

fn corner_ids(c: &mut Cursor<'_>, below: usize) -> Result<[u32; 3], CodecError> {
    let ids = [c.id()?, c.id()?, c.id()?];
    if ids.iter().any(|id| *id as usize >= below) {
        return Err(c.malformed("id out of range"));
    }
    Ok(ids)
}

fn read_wedges(c: &mut Cursor<'_>, mesh: &mut Mesh) -> Result<(), CodecError> {
    let mut w = 0_usize;
    for _ in 0..c.count(1)? {
        w = w.saturating_add(c.id()? as usize);
        for layer in &mut mesh.layers {
            let at = w.saturating_mul(layer.width);
            let Some(values) = layer.values.get_mut(at..at.saturating_add(layer.width)) else {
                return Err(c.malformed("wedge id out of range"));
            };
            for v in values {
                *v = c.f32()?;
            }
        }
    }
    Ok(())
}
