//! Skins: joints, their inverse bind matrices, and what moves which vertex.
//!
//! A mesh with a skin is read as it was bound, where its first joint puts it: world space is then
//! `world_from_joint joint_from_mesh` of that joint, which is where the others put it too unless joints have been moved
//! since. Inverse bind matrices are brought to that space, so that any pose moves what is written as it
//! moved what was read. Where the bind pose is world space but for rounding, matrices stay as they are.
//!
//! A mesh without a skin below a joint goes along with that joint: it gets a skin of this one.

use std::ops::Range;

use glam::DMat4;
use gltf::json::{accessor::Type, mesh::Semantic as JsonSemantic, skin::Skin};
use serde_json::{Map, json};

use super::{
    super::soup::Attribute,
    Document, IoError, Soup,
    primitive::Values,
    scene::{Placement, Visited, kept_name},
};
use crate::mesh::{self, Semantic, Tree, skin};

/// Joints of all skins together; singles count further.
const MAX_JOINTS: u64 = 1 << 20;
/// Sets of joints that a vertex may have.
const MAX_SETS: u32 = 8;

/// Gives placements their skins, and nodes that move them their transforms.
pub(super) fn bind(
    document: &Document<'_>,
    soup: &mut Soup,
    visited: &Visited,
    placements: &mut [Placement],
) -> Result<(), IoError> {
    let mut placements_of = vec![Vec::new(); document.root.skins.len()];
    for (at, placement) in placements.iter().enumerate() {
        let Some(skin) = document.root.nodes[placement.node].skin else { continue };
        let Some(of_skin) = placements_of.get_mut(skin.value()) else {
            let place = format!("node {}", placement.node);
            let n = document.root.skins.len() as u64;
            return Err(document.source.out_of_range(place, "skins", skin.value() as i64, n));
        };
        of_skin.push(at);
    }
    for (skin, of_skin) in placements_of.iter().enumerate().filter(|(_, all)| !all.is_empty()) {
        let Some((skin, world_from_mesh)) = read_skin(document, soup, visited, skin)? else {
            continue;
        };
        for at in of_skin {
            placements[*at].world_from_mesh = world_from_mesh;
            put_on(&mut soup.tree, &mut placements[*at], skin);
        }
    }
    if soup.tree.skins.is_empty() {
        return Ok(());
    }
    let text = "skins are kept; pictures show the pose that meshes were bound in";
    soup.notes.add("skins_carried", text);
    hang_on_joints(&mut soup.tree, visited, placements);
    keep_transforms(document, &mut soup.tree, visited);
    Ok(())
}

fn put_on(tree: &mut Tree, placement: &mut Placement, skin: u32) {
    tree.parts[placement.part as usize].skin = Some(skin);
    placement.joints = tree.skins[skin as usize].numbers();
}

/// Adds a skin, whose joints are numbered behind those of the last one; returns its index.
fn push_skin(tree: &mut Tree, skin: mesh::Skin) -> u32 {
    let first_joint = tree.skins.last().map_or(0, |last| last.numbers().end);
    tree.skins.push(mesh::Skin { first_joint, ..skin });
    tree.skins.len() as u32 - 1
}

/// The skin's index in the soup's tree and where it puts meshes; `None` with a note where its joints are not in
/// the scene.
fn read_skin(
    document: &Document<'_>,
    soup: &mut Soup,
    visited: &Visited,
    index: usize,
) -> Result<Option<(u32, DMat4)>, IoError> {
    let skin = &document.root.skins[index];
    let place = format!("skin {index}");
    let n_before = soup.tree.skins.last().map_or(0, |last| last.numbers().end);
    let n_joints = u64::from(n_before) + skin.joints.len() as u64;
    document.source.check_limit(&place, "joints", n_joints, MAX_JOINTS)?;
    let places: Option<Vec<_>> =
        skin.joints.iter().map(|j| visited.get(j.value()).copied().flatten()).collect();
    let Some((first, places)) = places.and_then(|p| Some((*p.first()?, p))) else {
        soup.notes.add("skins_ignored", "a skin is ignored: its joints are not in the scene");
        return Ok(None);
    };
    let inverse_bind = inverse_bind_matrices(document, skin, &place)?;
    let world_from_mesh = bound(first.world_from_node, inverse_bind[0]);
    let mesh_from_world = world_from_mesh.inverse();
    let joint_from_world = inverse_bind
        .iter()
        .map(|joint_from_mesh| (*joint_from_mesh * mesh_from_world).to_cols_array());
    let skeleton = skin.skeleton.and_then(|s| visited.get(s.value()).copied().flatten());
    let skin = mesh::Skin {
        name: kept_name(skin.name.as_deref()),
        joints: places.iter().map(|p| p.own).collect(),
        joint_from_world: joint_from_world.collect(),
        skeleton: skeleton.map(|s| s.own),
        ..mesh::Skin::default()
    };
    Ok(Some((push_skin(&mut soup.tree, skin), world_from_mesh)))
}

/// One for each joint; without an accessor they are the identity.
fn inverse_bind_matrices(
    document: &Document<'_>,
    skin: &Skin,
    place: &str,
) -> Result<Vec<DMat4>, IoError> {
    let n = skin.joints.len();
    let Some(accessor) = skin.inverse_bind_matrices else { return Ok(vec![DMat4::IDENTITY; n]) };
    let place = format!("{place}, inverseBindMatrices");
    let view = document.accessor(accessor.value(), &[Type::Mat4], &place)?;
    if view.count < n as u64 {
        return Err(document.source.out_of_range(place, "matrices", n as i64 - 1, view.count));
    }
    document.source.check_limit(&place, "matrices", view.count, MAX_JOINTS)?;
    let values = document.floats(&view, false, &place)?;
    let matrices = values.as_chunks::<16>().0.iter().take(n);
    Ok(matrices.map(|m| DMat4::from_cols_array(&m.map(f64::from))).collect())
}

/// Where a joint puts what was bound to it: world space itself where it is but for rounding, or where the matrices make
/// no sense.
fn bound(world_from_joint: DMat4, joint_from_mesh: DMat4) -> DMat4 {
    const ROUNDING: f64 = 1e-5;
    let world_from_mesh = world_from_joint * joint_from_mesh;
    let far = |m: DMat4| m.w_axis.truncate().abs().max_element();
    let reach = far(world_from_joint).max(far(joint_from_mesh));
    let off = (world_from_mesh - DMat4::IDENTITY).to_cols_array_2d();
    let is_same = off[..3].iter().flatten().all(|x| x.abs() <= ROUNDING)
        && off[3].iter().all(|x| x.abs() <= ROUNDING * reach);
    let is_sound = world_from_mesh.is_finite() && world_from_mesh.inverse().is_finite();
    if is_same || !is_sound { DMat4::IDENTITY } else { world_from_mesh }
}

/// Skins of one joint for meshes without a skin at or below a joint.
fn hang_on_joints(tree: &mut Tree, visited: &Visited, placements: &mut [Placement]) {
    let mut joint_above: Vec<Option<u32>> = vec![None; tree.nodes.len()];
    let joints = tree.skins.iter().flat_map(|s| &s.joints);
    joints.for_each(|joint| joint_above[*joint as usize] = Some(*joint));
    // Parents come before their children.
    for node in 0..joint_above.len() {
        let parent = tree.parent(node as u32);
        joint_above[node] = joint_above[node].or_else(|| joint_above[parent? as usize]);
    }
    let mut world_from_node = vec![DMat4::ZERO; tree.nodes.len()];
    let places = visited.iter().flatten();
    places.for_each(|place| world_from_node[place.own as usize] = place.world_from_node);
    let mut of_joint = vec![None; tree.nodes.len()];
    for placement in placements.iter_mut().filter(|p| p.joints.is_empty()) {
        let node = tree.parts[placement.part as usize].node;
        let Some(joint) = joint_above[node as usize] else { continue };
        let joint_from_world = world_from_node[joint as usize].inverse();
        if !joint_from_world.is_finite() {
            continue;
        }
        let skin = *of_joint[joint as usize].get_or_insert_with(|| {
            let joint_from_world = vec![joint_from_world.to_cols_array()];
            let skin = mesh::Skin { joints: vec![joint], joint_from_world, ..Default::default() };
            push_skin(tree, skin)
        });
        put_on(tree, placement, skin);
    }
}

/// Keeps the transforms of joints, and of what is above them.
fn keep_transforms(document: &Document<'_>, tree: &mut Tree, visited: &Visited) {
    let mut moves = vec![false; tree.nodes.len()];
    let skins = tree.skins.iter();
    skins.flat_map(|s| s.joints.iter().chain(&s.skeleton)).for_each(|j| moves[*j as usize] = true);
    // Parents come before their children.
    for node in (0..moves.len()).rev() {
        if let Some(parent) = tree.parent(node as u32).filter(|_| moves[node]) {
            moves[parent as usize] = true;
        }
    }
    for (node, place) in document.root.nodes.iter().zip(visited) {
        let Some(place) = place.filter(|p| moves[p.own as usize]) else { continue };
        let mut transform = Map::new();
        let rows = [
            ("matrix", node.matrix.map(|m| json!(m))),
            ("translation", node.translation.map(|t| json!(t))),
            ("rotation", node.rotation.map(|r| json!(r.0))),
            ("scale", node.scale.map(|s| json!(s))),
        ];
        transform.extend(rows.into_iter().filter_map(|(key, v)| Some((key.to_owned(), v?))));
        tree.nodes[place.own as usize].transform = Some(transform);
    }
}

/// What moves each vertex of a primitive, for a placement that has joints. What nothing moves, the first one does.
pub(super) fn read_joints(
    values: &Values<'_>,
    joints: &Range<u32>,
    soup: &mut Soup,
    place: &str,
) -> Result<Option<Attribute>, IoError> {
    if joints.is_empty() {
        return Ok(None);
    }
    let sets = joint_sets(values, soup, place)?;
    let n_joints = joints.len() as u64;
    let mut skins = Vec::with_capacity(values.n_points as usize * skin::WIDTH);
    for point in 0..values.n_points as usize {
        let of_point = sets.iter().flat_map(|(indices, shares)| {
            indices[4 * point..][..4].iter().zip(&shares[4 * point..][..4])
        });
        let moving = of_point.filter(|(_, share)| **share > 0.0);
        if let Some((joint, _)) = moving.clone().find(|(joint, _)| **joint >= n_joints as f32) {
            let place = format!("{place}, vertex {point}");
            let source = values.document.source;
            return Err(source.out_of_range(place, "joints", *joint as i64, n_joints));
        }
        let shares = moving.map(|(j, share)| (joints.start + *j as u32, (*share).into()));
        let mut found = skin::settled(shares);
        if found[skin::MAX_JOINTS] == 0.0 {
            if n_joints > 1 {
                soup.notes.add("skin_mended", "what no joint moves goes along with the first one");
            }
            found = skin::settled([(joints.start, 1.0)]);
        }
        skins.extend(found);
    }
    Ok(Some(Attribute { semantic: Semantic::Skin, values: skins }))
}

/// Joints and shares, four for each vertex.
type Set = (Vec<f32>, Vec<f32>);

/// All sets that are whole.
fn joint_sets(values: &Values<'_>, soup: &mut Soup, place: &str) -> Result<Vec<Set>, IoError> {
    let four: &[Type] = &[Type::Vec4];
    let mut sets = Vec::new();
    for set in 0..MAX_SETS {
        let indices = values.column(&JsonSemantic::Joints(set), (four, false), place)?;
        let shares = values.column(&JsonSemantic::Weights(set), (four, false), place)?;
        let (Some((indices, _)), Some((shares, _))) = (indices, shares) else { break };
        sets.push((indices, shares));
    }
    if sets.len() > 1 {
        soup.notes.add("skin_reduced", "four joints of a vertex are kept, those that move it most");
    }
    Ok(sets)
}
