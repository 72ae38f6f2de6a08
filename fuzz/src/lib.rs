//! Bodies of the fuzz targets, seeds for them, and a mutation loop for compilers without libFuzzer.
//!
//! A body must not panic, hang or ask for much memory, whatever the bytes.

mod archive;
mod document;
mod glb;

use lookalike::{
    io::{self, Limits, PlyPositions},
    mesh::{
        AttributeLayer, Collapse, Corner, EditMesh, EditRecord, FaceId, Mesh, RemovedFace,
        Semantic, VertexId, WedgeId,
    },
    progressive::{
        ProgressiveError, ReadLimits, Reader, Replay, Writer, decode_collapse, decode_edit,
        encode_collapse, encode_edit,
    },
};

/// A target of the mutation loop.
pub struct Target {
    /// Its name, as cargo-fuzz knows it.
    pub name: &'static str,
    /// What must survive any bytes.
    pub body: fn(&[u8]),
    /// Valid inputs to start from.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Damages one of them.
    change: fn(&mut Vec<u8>, &mut Random),
}

/// All targets.
pub const TARGETS: [Target; 9] = [
    Target { name: "read_glb", body: read_glb, seeds: glb::seeds, change: document::change_glb },
    Target { name: "read_gltf", body: read_gltf, seeds: gltf_seeds, change: document::change_gltf },
    Target { name: "read_ply", body: read_ply, seeds: ply_seeds, change: any_bytes },
    Target { name: "read_obj", body: read_obj, seeds: obj_seeds, change: any_bytes },
    Target { name: "read_stl", body: read_stl, seeds: stl_seeds, change: any_bytes },
    Target { name: "read_zip", body: read_zip, seeds: archive::seeds, change: archive::change },
    Target {
        name: "progressive_file",
        body: progressive_file,
        seeds: file_seeds,
        change: any_bytes,
    },
    Target {
        name: "progressive_records",
        body: progressive_records,
        seeds: record_seeds,
        change: any_bytes,
    },
    Target {
        name: "progressive_edits",
        body: progressive_edits,
        seeds: edit_seeds,
        change: any_bytes,
    },
];

/// GLB reader.
pub fn read_glb(bytes: &[u8]) {
    read("a.glb", bytes);
}

/// glTF reader.
pub fn read_gltf(bytes: &[u8]) {
    read("a.gltf", bytes);
}

/// PLY reader.
pub fn read_ply(bytes: &[u8]) {
    read("a.ply", bytes);
}

/// OBJ reader.
pub fn read_obj(bytes: &[u8]) {
    read("a.obj", bytes);
}

/// STL reader.
pub fn read_stl(bytes: &[u8]) {
    read("a.stl", bytes);
}

/// Archives, and what is in them.
pub fn read_zip(bytes: &[u8]) {
    read("a.zip", bytes);
}

fn read(name: &str, bytes: &[u8]) {
    let limits = Limits {
        max_triangles: 100_000,
        max_vertices: 100_000,
        max_json_objects: 10_000,
        ..Limits::default()
    };
    if let Ok(ingest) = io::read(name, bytes, &limits) {
        // What was read can be written, and read again.
        let compressed = io::GlbOptions { quantize: true, compress: true };
        for options in [io::GlbOptions::default(), compressed] {
            if let Ok(glb) = io::write_glb_with(&ingest.mesh, options) {
                let _ = io::read("b.glb", &glb, &limits);
            }
        }
    }
}

/// Header, coarsest mesh, records both ways, levels, their edits both ways.
pub fn progressive_file(bytes: &[u8]) {
    let limits = ReadLimits {
        max_faces: 100_000,
        max_vertices: 100_000,
        max_attribute_values: 1_000_000,
        max_edits: 100_000,
        max_section_bytes: 1 << 20,
        max_corner_visits: 1_000_000,
    };
    let Ok(reader) = Reader::open_with(bytes, limits) else { return };
    let header = reader.header();
    let _ = reader.extract(header.n_base_faces / 2 + header.n_faces / 2);
    if let Ok(mut collapses) = reader.fine_to_coarse() {
        let original = collapses.to_mesh();
        while collapses.collapse().is_ok_and(|c| c.is_some()) {}
        let _ = (original, collapses.to_mesh());
    }
    for level in header.levels.iter().take(4) {
        let _ = reader.extract_level(&level.name);
        if let Ok(mut edits) = reader.edits_backward(&level.name) {
            while edits.undo().is_ok_and(|e| e.is_some()) {}
            let _ = edits.to_mesh();
        }
    }
}

/// Stand-alone records, applied to a mesh and undone.
pub fn progressive_records(mut bytes: &[u8]) {
    let Ok(mut replay) = Replay::from_mesh(&octahedron()) else { return };
    let mut applied = Vec::new();
    while let Ok((collapse, n_bytes)) = decode_collapse(bytes) {
        let mut again = Vec::new();
        encode_collapse(&collapse, &mut again);
        bytes = &bytes[n_bytes..];
        if replay.apply(&collapse).is_ok() {
            applied.push(collapse);
        } else {
            let _ = replay.undo(&collapse);
        }
    }
    let _ = replay.to_mesh();
    while let Some(collapse) = applied.pop() {
        let _ = replay.undo(&collapse);
    }
}

/// Stand-alone records of any kind, applied to a mesh and undone.
pub fn progressive_edits(mut bytes: &[u8]) {
    let Ok(mut replay) = Replay::from_mesh(&octahedron()) else { return };
    let mut applied = Vec::new();
    while let Ok((record, n_bytes)) = decode_edit(bytes) {
        let mut again = Vec::new();
        encode_edit(record.edit(), &mut again);
        bytes = &bytes[n_bytes..];
        if replay.apply_edit(record.edit()).is_ok() {
            applied.push(record);
        } else {
            let _ = replay.undo_edit(record.edit());
        }
    }
    let _ = replay.to_mesh();
    while let Some(record) = applied.pop() {
        let _ = replay.undo_edit(record.edit());
    }
    let _ = replay.to_mesh();
}

/// Eight triangles, a texture coordinate per vertex.
fn octahedron() -> Mesh {
    let corners = "v 1 0 0\nv -1 0 0\nv 0 1 0\nv 0 -1 0\nv 0 0 1\nv 0 0 -1\n\
        f 1 3 5\nf 3 2 5\nf 2 4 5\nf 4 1 5\nf 3 1 6\nf 2 3 6\nf 4 2 6\nf 1 4 6\n";
    let mut mesh = io::read("a.obj", corners.as_bytes(), &Limits::default())
        .map(|ingest| ingest.mesh)
        .unwrap_or_default();
    mesh.face_wedges = mesh.faces.clone();
    let values = (0..12_u8).map(|i| f32::from(i) / 8.0).collect();
    mesh.layers = vec![AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values }];
    mesh
}

/// The collapse of the octahedron's first edge to its first end, with a new wedge.
fn first_collapse(mesh: &Mesh) -> Collapse {
    let (keep, drop) = (mesh.faces[0][0], mesh.faces[0][1]);
    let faces = || mesh.faces.iter().enumerate().filter(|(_, f)| f.contains(&drop));
    let removed: Vec<_> = faces()
        .filter(|(_, f)| f.contains(&keep))
        .map(|(i, f)| RemovedFace {
            face: FaceId(i as u32),
            vertices: f.map(VertexId),
            wedges: f.map(WedgeId),
        })
        .collect();
    let moved: Vec<_> = faces()
        .filter(|(_, f)| !f.contains(&keep))
        .flat_map(|(i, f)| f.iter().position(|v| *v == drop).map(|k| (i, k)))
        .map(|(i, k)| Corner::new(FaceId(i as u32), k))
        .collect();
    let at = |v: u32| mesh.positions[v as usize];
    Collapse {
        keep: VertexId(keep),
        drop: VertexId(drop),
        keep_from: at(keep),
        drop_from: at(drop),
        to: at(keep) * 0.7,
        removed: removed.into(),
        moved: moved.into(),
        rewedged: Vec::new().into(),
        first_new_wedge: WedgeId(6),
        new_wedges: vec![0.25, 0.5],
    }
}

/// Edits of every kind, one after another.
fn some_edits(mesh: &Mesh) -> Vec<EditRecord> {
    let Ok(mut edited) = EditMesh::new(mesh.clone()) else { return Vec::new() };
    let [a, b, c] = mesh.faces[0].map(VertexId);
    let middle = (edited.position(a) + edited.position(b)) * 0.5;
    let values = [(a, [0.5, 0.25]), (c, [1.0, 0.0])];
    let collapse = EditRecord::Collapse(edited.collapse(b, c, middle * 1.5));
    let mut edits = vec![collapse, EditRecord::Displacement(edited.displace(a, middle * 0.5))];
    edits.extend(edited.split(a, b, middle).map(EditRecord::Split));
    edits.extend(edited.revalue(Semantic::TexCoord(0), &values).map(EditRecord::Revalue));
    let apex = VertexId(edited.n_vertex_slots() as u32 - 1);
    let mut around = Vec::new();
    edited.neighbours(apex, &mut around);
    let swap = around.into_iter().find_map(|end| edited.swap(apex, end));
    edits.extend(swap.map(EditRecord::Swap));
    edits
}

fn edit_seeds() -> Vec<Vec<u8>> {
    let mut seed = Vec::new();
    some_edits(&octahedron()).iter().for_each(|record| encode_edit(record.edit(), &mut seed));
    vec![seed]
}

fn gltf_seeds() -> Vec<Vec<u8>> {
    vec![
        br#"{"asset":{"version":"2.0"},"nodes":[{"mesh":0,"scale":[2,2,2],"children":[1]},{"mesh":0}],
"meshes":[{"primitives":[{"attributes":{"POSITION":0},"mode":5,"material":0}]}],
"materials":[{"pbrMetallicRoughness":{"baseColorFactor":[1,0,0,1]}}],
"accessors":[{"bufferView":0,"componentType":5121,"count":4,"type":"VEC3","normalized":true,
"sparse":{"count":1,"indices":{"bufferView":1,"componentType":5121},"values":{"bufferView":0}}}],
"bufferViews":[{"buffer":0,"byteLength":16,"byteStride":4},{"buffer":0,"byteOffset":16,"byteLength":4}],
"buffers":[{"byteLength":20,"uri":"data:;base64,AAAAAP8AAAAA/wAA//8AAAMAAAA="}]}"#
            .to_vec(),
    ]
}

fn ply_seeds() -> Vec<Vec<u8>> {
    let precisions = [PlyPositions::Single, PlyPositions::Double];
    let mut seeds: Vec<_> =
        precisions.iter().flat_map(|p| io::write_ply(&octahedron(), *p)).collect();
    seeds.push(
        b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n\
        property float z\nproperty uchar red\nelement tristrips 1\n\
        property list int int vertex_indices\nend_header\n0 0 0 1\n1 0 0 2\n0 1 0 3\n1 1 0 4\n\
        5 0 1 2 3 -1\n"
            .to_vec(),
    );
    seeds
}

fn obj_seeds() -> Vec<Vec<u8>> {
    let mut seeds: Vec<_> = io::write_obj(&octahedron()).into_iter().collect();
    seeds.push(
        b"mtllib a\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvn 0 0 1\nusemtl a\n\
          f 1/1/1 2//1 \\\n-1\n"
            .to_vec(),
    );
    seeds
}

fn stl_seeds() -> Vec<Vec<u8>> {
    let mut binary = vec![b' '; 80];
    binary.extend(1_u32.to_le_bytes());
    let values = [0.0_f32, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    binary.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    binary.extend([0, 0]);
    let text = b"solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n\
        vertex 0 1 0\nendloop\nendfacet\nendsolid s\n";
    vec![binary, text.to_vec()]
}

fn file_seeds() -> Vec<Vec<u8>> {
    let mesh = octahedron();
    let Ok(mut writer) = Writer::new(&mesh) else { return Vec::new() };
    let plain = writer.clone().finish();
    writer.mark_level("a");
    let edited = with_edits(writer.clone(), &mesh);
    let with_record = match writer.push(&first_collapse(&mesh)) {
        Ok(()) => writer.finish(),
        Err(error) => Err(error),
    };
    [plain, with_record, edited].into_iter().flatten().collect()
}

fn with_edits(mut writer: Writer, mesh: &Mesh) -> Result<Vec<u8>, ProgressiveError> {
    writer.begin_edits("a", mesh)?;
    for record in some_edits(mesh) {
        writer.push_edit(record.edit())?;
    }
    writer.push(&first_collapse(mesh))?;
    writer.finish()
}

fn record_seeds() -> Vec<Vec<u8>> {
    let mut seed = Vec::new();
    encode_collapse(&first_collapse(&octahedron()), &mut seed);
    vec![seed]
}

/// The `index`-th input of a run: a seed with changes that `index` and `seed` determine.
pub fn input(target: &Target, seeds: &[Vec<u8>], seed: u64, index: u64) -> Vec<u8> {
    let name = target.name.bytes().fold(seed, |h, b| h.wrapping_mul(31).wrapping_add(b.into()));
    let mut random = Random(name ^ index.wrapping_mul(0xD134_2543_DE82_EF95));
    let mut bytes = seeds.get(random.below(seeds.len())).cloned().unwrap_or_default();
    (target.change)(&mut bytes, &mut random);
    bytes
}

/// One to eight edits.
fn any_bytes(bytes: &mut Vec<u8>, random: &mut Random) {
    (0..=random.below(8)).for_each(|_| edit(bytes, random));
}

/// Values at which counts and offsets go wrong.
const EDGES: [u64; 10] = [
    0,
    1,
    0x7f,
    0xff,
    0xffff,
    0x7fff_ffff,
    0xffff_ffff,
    0x7ff0_0000_0000_0000,
    u64::MAX / 2,
    u64::MAX,
];

fn edit(bytes: &mut Vec<u8>, random: &mut Random) {
    let at = random.below(bytes.len());
    let edge = EDGES[random.below(EDGES.len())].to_le_bytes();
    let width = [1, 2, 4, 8][random.below(4)];
    match random.below(8) {
        0 => bytes.iter_mut().skip(at).take(1).for_each(|b| *b = random.next() as u8),
        1 => bytes.iter_mut().skip(at).take(1).for_each(|b| *b ^= 1 << (random.next() % 8)),
        2 => bytes.iter_mut().skip(at).zip(&edge[..width]).for_each(|(b, v)| *b = *v),
        3 => bytes.truncate(at),
        4 => bytes.insert(at, random.next() as u8),
        5 => drop(bytes.drain(at..(at + random.below(16)).min(bytes.len()))),
        6 => {
            let end = (at + random.below(64)).min(bytes.len());
            let copy = bytes[at..end].to_vec();
            let to = random.below(bytes.len());
            bytes.splice(to..to, copy);
        }
        // A digit: numbers in text.
        _ => bytes
            .iter_mut()
            .skip(at)
            .take(1)
            .for_each(|b| *b = b"0123456789-.en "[random.below(15)]),
    }
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n.max(1) as u64) as usize
    }
}

#[cfg(test)]
mod tests {
    use lookalike::mesh::Image;

    use super::*;

    /// Seeds must be valid, or the loop would only exercise the first check.
    #[test]
    fn seeds_are_valid() {
        let limits = Limits::default();
        // How many images there are, all of them decoded.
        let is_model = |name: &str, seeds: Vec<Vec<u8>>| {
            assert!(!seeds.is_empty());
            let images_of = |seed: Vec<u8>| io::read(name, &seed, &limits).unwrap().mesh.images;
            let images: Vec<Image> = seeds.into_iter().flat_map(images_of).collect();
            assert!(images.iter().all(|image| image.pixels.is_some()));
            images.len()
        };
        assert_eq!(glb::seeds().len(), 13);
        // Two of them beside Draco geometry.
        assert_eq!(is_model("a.glb", glb::seeds()), 2 + 2 + 3);
        is_model("a.gltf", gltf_seeds());
        is_model("a.ply", ply_seeds());
        is_model("a.obj", obj_seeds());
        is_model("a.stl", stl_seeds());
        assert_eq!(is_model("a.zip", archive::seeds()), 1);
        assert_eq!(file_seeds().len(), 3);
        for seed in file_seeds() {
            assert_eq!(Reader::open(&seed).unwrap().extract(8).unwrap(), octahedron());
        }
        let reader = file_seeds().pop();
        let reader = Reader::open(reader.as_deref().unwrap()).unwrap();
        assert_eq!(reader.edits_forward("a").unwrap().flatten().count(), 5);
        let (mut bytes, mut replay) =
            (&edit_seeds()[0][..], Replay::from_mesh(&octahedron()).unwrap());
        while let Ok((record, n_bytes)) = decode_edit(bytes) {
            replay.apply_edit(record.edit()).unwrap();
            bytes = &bytes[n_bytes..];
        }
        assert!(bytes.is_empty());
        let (collapse, _) = decode_collapse(&record_seeds()[0]).unwrap();
        Replay::from_mesh(&octahedron()).unwrap().apply(&collapse).unwrap();
    }

    /// Most must not be turned away at the door.
    #[test]
    fn mutations_get_far() {
        let (target, seeds) = (&TARGETS[0], glb::seeds());
        let mut ends = std::collections::BTreeMap::new();
        for index in 0..5_000 {
            let bytes = input(target, &seeds, 1, index);
            let end = match io::read("a.glb", &bytes, &Limits::default()) {
                Ok(_) => "read",
                Err(error) => error.code(),
            };
            *ends.entry(end).or_insert(0) += 1;
        }
        assert!(ends["read"] > 1_000 && ends.len() > 5, "{ends:?}");
    }

    #[test]
    fn a_bounded_run_finds_nothing() {
        for target in &TARGETS {
            let seeds = (target.seeds)();
            for index in 0..5_000 {
                (target.body)(&input(target, &seeds, 1, index));
            }
        }
    }
}
