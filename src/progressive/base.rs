//! The coarsest mesh in the file.
//!
//! ```text
//! vertices     each: ids: its id, signed from the id before plus 1; three doubles predicted by
//!              the vertex before
//! faces        each: ids: its id, likewise; its vertices, each signed from the vertex before;
//!              with materials per face: small: 0: as the face before, else 1 + material;
//!              with layers: its wedges, each signed from the wedge before
//! wedges       each: ids: its id, likewise; a single per value, predicted by the wedge before.
//!              Those of the faces, and those that no face of any level uses
//! ```
//!
//! Only what is there at the coarsest level is stored, under the ids of the original mesh. Like
//! a record, it is one walk with two coders.

use super::{coder::Coder, error::Damage, replay::Replay};

/// Codes vertices and faces. `vertices` and `faces` are the ids, which a decoder fills in; in the
/// replay they are then alive.
pub(super) fn code_mesh<C: Coder>(
    coder: &mut C,
    replay: &mut Replay,
    vertices: &mut [u32],
    faces: &mut [u32],
) -> Result<(), Damage> {
    let (mut next, mut before) = (0, [0.0; 3]);
    for id in vertices {
        next = ascending(coder, next, replay.positions.len(), id)?;
        replay.is_vertex_alive[*id as usize] = true;
        let position = &mut replay.positions[*id as usize];
        for (x, guess) in position.iter_mut().zip(before) {
            coder.double(guess, x)?;
        }
        before = *position;
    }
    let (mut next, mut last) = (0, Last::default());
    for id in faces {
        next = ascending(coder, next, replay.faces.len(), id)?;
        code_face(coder, replay, *id as usize, &mut last)?;
    }
    Ok(())
}

/// What the face before had.
#[derive(Default)]
struct Last {
    vertex: u32,
    material: u32,
    wedge: u32,
}

fn code_face<C: Coder>(
    coder: &mut C,
    replay: &mut Replay,
    id: usize,
    last: &mut Last,
) -> Result<(), Damage> {
    let face = &mut replay.faces[id];
    for vertex in face.iter_mut() {
        coder.near(last.vertex, vertex)?;
        last.vertex = *vertex;
        if replay.is_vertex_alive.get(*vertex as usize) != Some(&true) {
            return Err(Damage("a face names a vertex that is not there"));
        }
    }
    let [a, b, c] = *face;
    if a == b || b == c || c == a {
        return Err(Damage("a face has a repeated vertex"));
    }
    if let Some(material) = replay.face_materials.get_mut(id) {
        let mut code = if *material == last.material { 0 } else { u64::from(*material) + 1 };
        coder.small(&mut code)?;
        if code > 0 {
            let found = u32::try_from(code - 1);
            last.material = found.map_err(|_| Damage("a material is over 32 bits"))?;
        }
        *material = last.material;
    }
    for wedge in replay.face_wedges.get_mut(id).into_iter().flatten() {
        coder.near(last.wedge, wedge)?;
        last.wedge = *wedge;
        if *wedge >= replay.n_wedges {
            return Err(Damage("a face names a wedge that is not there"));
        }
    }
    Ok(())
}

/// Codes the values of the wedges whose ids are in `wedges`; a decoder fills the ids in.
pub(super) fn code_wedges<C: Coder>(
    coder: &mut C,
    replay: &mut Replay,
    wedges: &mut [u32],
) -> Result<(), Damage> {
    let (width, mut next) = (replay.width(), 0);
    let n_wedges = replay.wedge_values.len() / width.max(1);
    let mut before = vec![0.0; width];
    for id in wedges {
        next = ascending(coder, next, n_wedges, id)?;
        let at = *id as usize * width;
        for (value, guess) in replay.wedge_values[at..at + width].iter_mut().zip(&mut before) {
            coder.single(*guess, value)?;
            *guess = *value;
        }
    }
    Ok(())
}

/// Codes an id that is at least `next`; returns the least that may follow.
fn ascending<C: Coder>(coder: &mut C, next: u32, n: usize, id: &mut u32) -> Result<u32, Damage> {
    coder.near(next, id)?;
    if *id < next || *id as usize >= n {
        return Err(Damage("ids do not ascend"));
    }
    Ok(*id + 1)
}
