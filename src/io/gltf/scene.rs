//! The node tree: which mesh stands where, and under which names.

use glam::{DMat4, DQuat, DVec3, Quat, Vec3};
use gltf::json::{Index, Node};

use super::{Document, IoError, REMEDY, Soup, skin};
use crate::mesh;

/// A mesh as a node places it.
pub(super) struct Placement {
    pub(super) node: usize,
    pub(super) mesh: usize,
    pub(super) world_from_mesh: DMat4,
    /// Index into the parts of the soup's tree.
    pub(super) part: u32,
    /// The numbers of its skin's joints; none without a skin.
    pub(super) joints: std::ops::Range<u32>,
}

/// Where nodes of the file are, by their index there.
pub(super) type Visited = Vec<Option<Place>>;

/// A node that the scene has.
#[derive(Clone, Copy)]
pub(super) struct Place {
    /// Index into the nodes of the soup's tree.
    pub(super) own: u32,
    pub(super) world_from_node: DMat4,
}

/// Characters of a name that are kept: names may stand in a file often.
const MAX_NAME_CHARS: usize = 256;

/// A node to visit: its index, the transform above it, and its parent in the soup's tree.
type Visit = (usize, DMat4, Option<u32>);

/// Depth first, in the order of the file. Nodes form trees: one that is reached twice is an error,
/// which also ends cycles. Fills in the soup's tree.
pub(super) fn placements(
    document: &Document<'_>,
    soup: &mut Soup,
) -> Result<Vec<Placement>, IoError> {
    let nodes = &document.root.nodes;
    let mut visited: Visited = vec![None; nodes.len()];
    let mut placements = Vec::new();
    let roots = roots(document)?.into_iter().rev();
    let mut stack: Vec<Visit> = roots.map(|root| (root, DMat4::IDENTITY, None)).collect();
    while let Some((index, world_from_parent, parent)) = stack.pop() {
        let place = || format!("node {index}");
        let Some(node) = nodes.get(index) else {
            let n = nodes.len() as u64;
            return Err(document.source.out_of_range("scene", "nodes", index as i64, n));
        };
        if visited[index].is_some() {
            let problem = "it is reached twice: it has two parents or contains itself";
            return Err(document.source.malformed(place(), problem, REMEDY));
        }
        let world_from_node = world_from_parent * parent_from_node(node);
        let own = soup.tree.nodes.len() as u32;
        visited[index] = Some(Place { own, world_from_node });
        let name = kept_name(node.name.as_deref());
        soup.tree.nodes.push(mesh::Node { name, parent, transform: None });
        if let Some(mesh) = node.mesh {
            let (mesh, world_from_mesh) = (mesh.value(), world_from_node);
            let part = soup.tree.parts.len() as u32;
            placements.push(Placement { node: index, mesh, world_from_mesh, part, joints: 0..0 });
            let name = document.root.meshes.get(mesh).and_then(|m| m.name.as_deref());
            soup.tree.parts.push(mesh::Part { node: own, mesh: kept_name(name), skin: None });
        }
        let children = node.children.iter().flatten().rev();
        stack.extend(children.map(|child| (child.value(), world_from_node, Some(own))));
    }
    skin::bind(document, soup, &visited, &mut placements)?;
    Ok(placements)
}

pub(super) fn kept_name(name: Option<&str>) -> String {
    name.into_iter().flat_map(str::chars).take(MAX_NAME_CHARS).collect()
}

/// The roots of the default scene (or the first); of a file without scenes, the nodes that are
/// nobody's children.
fn roots(document: &Document<'_>) -> Result<Vec<usize>, IoError> {
    let root = &document.root;
    let scene = root.scene.map_or(0, |s| s.value());
    if let Some(scene) = root.scenes.get(scene) {
        return Ok(scene.nodes.iter().map(Index::value).collect());
    }
    if root.scene.is_some() {
        let n = root.scenes.len() as u64;
        return Err(document.source.out_of_range("scene", "scenes", scene as i64, n));
    }
    let mut is_child = vec![false; root.nodes.len()];
    for child in root.nodes.iter().flat_map(|n| n.children.iter().flatten()) {
        if let Some(flag) = is_child.get_mut(child.value()) {
            *flag = true;
        }
    }
    Ok((0..root.nodes.len()).filter(|i| !is_child[*i]).collect())
}

fn parent_from_node(node: &Node) -> DMat4 {
    if let Some(matrix) = node.matrix {
        return DMat4::from_cols_array(&matrix.map(f64::from));
    }
    let rotation = node.rotation.map_or(DQuat::IDENTITY, |q| Quat::from_array(q.0).as_dquat());
    let length = rotation.length();
    let rotation = if length > 0.0 && length.is_finite() {
        // Written in single precision, so its length is off by a little.
        if length == 1.0 { rotation } else { rotation / length }
    } else {
        DQuat::IDENTITY
    };
    let scale = node.scale.map_or(DVec3::ONE, |s| Vec3::from_array(s).as_dvec3());
    let shift = node.translation.map_or(DVec3::ZERO, |t| Vec3::from_array(t).as_dvec3());
    DMat4::from_scale_rotation_translation(scale, rotation, shift)
}
