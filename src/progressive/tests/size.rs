//! How many bytes a record takes, on a surface like a scan: points in single precision, ids that
//! follow the surface, collapses of short edges to places in full double precision. And edits of a
//! level, which has double precision throughout.

use std::collections::BTreeSet;

use glam::DVec3;
use smallvec::SmallVec;

use super::reference::Rng;
use crate::{
    mesh::{
        AttributeLayer, Collapse, Corner, EditMesh, EditRecord, FaceId, Legality, Mesh,
        RemovedFace, Rewedged, Semantic, VertexId, WedgeId, shapes,
    },
    progressive::{Reader, Writer, encode_collapse, encode_edit, header::Header},
};

/// A bumpy torus of `n` × `n` squares, closed, with unit normals if asked.
fn torus(n: u32, has_normals: bool) -> Mesh {
    let mut mesh = Mesh::default();
    for i in 0..n * n {
        let angle = |k: u32| f64::from(k) / f64::from(n) * std::f64::consts::TAU;
        let (u, v) = (angle(i % n), angle(i / n));
        let r = 1.0 + 0.1 * (5.0 * u).sin() * (7.0 * v).cos();
        let p =
            DVec3::new((3.0 + r * v.cos()) * u.cos(), (3.0 + r * v.cos()) * u.sin(), r * v.sin());
        mesh.positions.push(p.as_vec3().as_dvec3());
    }
    for (x, y) in (0..n * n).map(|i| (i % n, i / n)) {
        let at = |x: u32, y: u32| y % n * n + x % n;
        let [a, b, c, d] = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)];
        mesh.faces.extend([[a, b, c], [c, b, d]]);
    }
    if has_normals {
        let sums = mesh.faces.iter().fold(vec![DVec3::ZERO; mesh.positions.len()], |mut s, f| {
            let [a, b, c] = f.map(|v| mesh.positions[v as usize]);
            for v in f {
                s[*v as usize] += (b - a).cross(c - a);
            }
            s
        });
        let values = sums.iter().flat_map(|s| s.normalize_or_zero().as_vec3().to_array()).collect();
        mesh.layers = vec![AttributeLayer { semantic: Semantic::Normal, width: 3, values }];
        mesh.face_wedges = mesh.faces.clone();
    }
    mesh
}

/// A collapse of the shortest edge at a random vertex that keeps the surface a manifold.
fn next_collapse(writer: &Writer, rng: &mut Rng) -> Option<Collapse> {
    let replay = writer.replay();
    let corners = |v: u32| replay.rings.of(v);
    let others = |v: u32| -> BTreeSet<u32> {
        corners(v).flat_map(|c| replay.faces[c as usize / 3]).filter(|x| *x != v).collect()
    };
    let at = |v: u32| DVec3::from_array(replay.positions[v as usize]);
    let keep = rng.below(replay.positions.len()) as u32;
    let around = others(keep);
    let drop = *around
        .iter()
        .min_by(|a, b| at(keep).distance(at(**a)).total_cmp(&at(keep).distance(at(**b))))?;
    let mut removed: SmallVec<[RemovedFace; 2]> = SmallVec::new();
    let mut moved: SmallVec<[Corner; 8]> = SmallVec::new();
    for corner in corners(drop) {
        let face = replay.faces[corner as usize / 3];
        if face.contains(&keep) {
            let wedges = replay.face_wedges.get(corner as usize / 3).copied().unwrap_or_default();
            removed.push(RemovedFace {
                face: FaceId(corner / 3),
                vertices: face.map(VertexId),
                wedges: wedges.map(WedgeId),
            });
        } else {
            moved.push(Corner(corner));
        }
    }
    if around.intersection(&others(drop)).count() != 2 || removed.len() != 2 {
        return None;
    }
    removed.sort_unstable_by_key(|f| f.face);
    moved.sort_unstable();
    let shift = DVec3::new(rng.signed(), rng.signed(), rng.signed()) * 0.2;
    let mut c = Collapse {
        keep: VertexId(keep),
        drop: VertexId(drop),
        keep_from: at(keep),
        drop_from: at(drop),
        to: (at(keep) + at(drop)) / 2.0 + shift * at(keep).distance(at(drop)),
        removed,
        moved,
        rewedged: SmallVec::new(),
        first_new_wedge: WedgeId(replay.n_wedges),
        new_wedges: Vec::new(),
    };
    if !replay.layers.is_empty() {
        merge_wedges(&mut c, writer, rng);
    }
    Some(c)
}

/// One new normal for all corners at the merged vertex.
fn merge_wedges(c: &mut Collapse, writer: &Writer, rng: &mut Rng) {
    let replay = writer.replay();
    let is_removed = |x: u32| c.removed.iter().any(|f| f.face.0 == x / 3);
    let mut corners: Vec<u32> = replay
        .rings
        .of(c.keep.0)
        .chain(replay.rings.of(c.drop.0))
        .filter(|x| !is_removed(*x))
        .collect();
    corners.sort_unstable();
    for corner in corners {
        let from = WedgeId(replay.face_wedges[corner as usize / 3][corner as usize % 3]);
        c.rewedged.push(Rewedged { corner: Corner(corner), from, to: c.first_new_wedge });
    }
    let old = replay.wedge(c.rewedged[0].from.0);
    let normal = DVec3::new(old[0].into(), old[1].into(), old[2].into());
    let tilt = DVec3::new(rng.signed(), rng.signed(), rng.signed()) * 0.1;
    c.new_wedges = (normal + tilt).normalize_or_zero().as_vec3().to_array().to_vec();
}

/// Bytes per record in the file and on a stream.
fn measure(mesh: &Mesh, to_faces: u32) -> (f64, f64) {
    let mut rng = Rng(11);
    let mut writer = Writer::new(mesh).unwrap();
    let mut stream = Vec::new();
    while writer.replay().n_faces() > to_faces {
        let Some(collapse) = next_collapse(&writer, &mut rng) else { continue };
        encode_collapse(&collapse, &mut stream);
        writer.push(&collapse).unwrap();
    }
    let n = f64::from(writer.n_records());
    let file = writer.finish().unwrap();
    let reader = Reader::open(&file).unwrap();
    assert_eq!(&reader.extract(u32::MAX).unwrap(), mesh);
    let header: &Header = reader.header();
    let in_blocks: u64 = header.blocks.iter().map(|b| b.section.n_packed()).sum();
    for k in 0..3 {
        let sum = |f: fn(&crate::progressive::Section) -> [u32; 3]| -> f64 {
            header.blocks.iter().map(|b| f64::from(f(&b.section)[k])).sum::<f64>() / n
        };
        println!("stream {k}: {:.1} raw, {:.1} packed", sum(|s| s.raw), sum(|s| s.packed));
    }
    (in_blocks as f64 / n, stream.len() as f64 / n)
}

#[test]
fn records_are_compact() {
    let (file, stream) = measure(&torus(80, false), 1000);
    println!("positions: {file:.1} bytes per record in the file, {stream:.1} on a stream");
    assert!(file < 40.0 && stream < 120.0, "{file} {stream}");
    let (file, stream) = measure(&torus(80, true), 1000);
    println!("normals too: {file:.1} bytes per record in the file, {stream:.1} on a stream");
    assert!(file < 60.0 && stream < 200.0, "{file} {stream}");
}

/// An edit as an optimizer makes it.
type Make = fn(&mut EditMesh, [VertexId; 2], DVec3) -> Option<EditRecord>;

/// Bytes per edit in the file and on a stream, for edits of random edges that end at places near
/// their middles.
fn measure_edits(mesh: &Mesh, n: usize, make: Make) -> (f64, f64) {
    let mut rng = Rng(7);
    let mut edited = EditMesh::new(mesh.clone()).unwrap();
    let mut writer = Writer::new(mesh).unwrap();
    writer.mark_level("a");
    writer.begin_edits("a", mesh).unwrap();
    let (mut around, mut stream, mut n_done) = (Vec::new(), Vec::new(), 0);
    while n_done < n {
        let a = VertexId(rng.below(mesh.positions.len()) as u32);
        edited.neighbours(a, &mut around);
        let Some(&b) = around.get(rng.below(around.len())) else { continue };
        let [p, q] = [a, b].map(|v| edited.position(v));
        let off = DVec3::new(rng.signed(), rng.signed(), rng.signed()) * p.distance(q) * 0.1;
        let Some(record) = make(&mut edited, [a, b], p.midpoint(q) + off) else { continue };
        writer.push_edit(record.edit()).unwrap();
        encode_edit(record.edit(), &mut stream);
        n_done += 1;
    }
    let file = writer.finish().unwrap();
    let reader = Reader::open(&file).unwrap();
    assert_eq!(reader.extract_level("a").unwrap(), edited.snapshot());
    let blocks = &reader.level("a").unwrap().edits.as_ref().unwrap().blocks;
    let n_packed: u64 = blocks.iter().map(|b| b.section.n_packed()).sum();
    (n_packed as f64 / n as f64, stream.len() as f64 / n as f64)
}

#[test]
fn edits_are_compact() {
    let mesh = shapes::torus(60, 40, 0.1);
    let kinds: [(&str, Make, [f64; 2]); 4] = [
        (
            "displacement",
            |m, [a, b], at| {
                let to = m.position(a) + (at - m.position(a).midpoint(m.position(b)));
                Some(EditRecord::Displacement(m.displace(a, to)))
            },
            [24.0, 52.0],
        ),
        ("swap", |m, [a, b], _| m.swap(a, b).map(EditRecord::Swap), [6.0, 16.0]),
        ("split", |m, [a, b], at| m.split(a, b, at).map(EditRecord::Split), [26.0, 44.0]),
        (
            "collapse",
            |m, [a, b], at| {
                let is_legal = m.legality(a, b) == Legality::Legal;
                is_legal.then(|| EditRecord::Collapse(m.collapse(a, b, at)))
            },
            [28.0, 100.0],
        ),
    ];
    for (kind, make, most) in kinds {
        let (file, stream) = measure_edits(&mesh, 1_500, make);
        println!("{kind}: {file:.1} bytes in the file, {stream:.1} on a stream");
        assert!(file < most[0] && stream < most[1], "{kind}: {file} {stream}");
    }
}
