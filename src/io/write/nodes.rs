//! The nodes of a GLB: the tree that the mesh came with, as far as it leads to triangles.
//!
//! Geometry is in world space and nodes do not move it, so that positions are those of the mesh,
//! rounded once, and parts that touch go on to touch. (Quantized, they are steps of one grid, and of a model far from the
//! origin they begin nearby; the nodes at the top bring both back.) Joints, and what is above them, do have transforms and are in the file once
//! (`skins`); parts below them are at the top.

use serde_json::{Value, json};

use crate::mesh::Tree;

/// A mesh of the file and the skin that moves it.
pub(super) type Placed = (usize, Option<usize>);

/// Adds the nodes; `meshes` says which mesh of the file each part has, if it has triangles. Returns
/// the nodes at the top.
pub(super) fn put_nodes(
    nodes: &mut Vec<Value>,
    tree: &Tree,
    meshes: &[Option<Placed>],
) -> Vec<usize> {
    let mut mesh_of_node = vec![None; tree.nodes.len()];
    let mut others = Vec::new();
    for (part, mesh) in meshes.iter().enumerate() {
        let Some(mesh) = mesh else { continue };
        let node = tree.parts.get(part).and_then(|p| mesh_of_node.get_mut(p.node as usize));
        match node {
            Some(own @ None) => *own = Some(*mesh),
            _ => others.push(*mesh),
        }
    }
    let leads = leading(tree, &mesh_of_node);
    let mut new_ids: Vec<Option<usize>> = vec![None; tree.nodes.len()];
    let mut roots = Vec::new();
    for node in (0..tree.nodes.len()).filter(|node| leads[*node]) {
        let above = tree.parent(node as u32).and_then(|parent| new_ids[parent as usize]);
        if tree.nodes[node].transform.is_some() && mesh_of_node[node].is_none() {
            new_ids[node] = above;
            continue;
        }
        let own = nodes.len();
        new_ids[node] = Some(own);
        match above {
            Some(above) => add_child(&mut nodes[above], own),
            None => roots.push(own),
        }
        nodes.push(value(&tree.nodes[node].name, mesh_of_node[node]));
    }
    for mesh in others {
        roots.push(nodes.len());
        nodes.push(value("", Some(mesh)));
    }
    roots
}

/// Which nodes have triangles, or nodes below that have.
fn leading(tree: &Tree, mesh_of_node: &[Option<Placed>]) -> Vec<bool> {
    let mut leads: Vec<bool> = mesh_of_node.iter().map(Option::is_some).collect();
    // Parents come before their children.
    for node in (0..leads.len()).rev() {
        if let Some(parent) = tree.parent(node as u32).filter(|_| leads[node]) {
            leads[parent as usize] = true;
        }
    }
    leads
}

fn value(name: &str, mesh: Option<Placed>) -> Value {
    let mut value = json!({});
    if !name.is_empty() {
        value["name"] = name.into();
    }
    if let Some((mesh, skin)) = mesh {
        value["mesh"] = mesh.into();
        skin.into_iter().for_each(|skin| value["skin"] = skin.into());
    }
    value
}

pub(super) fn add_child(parent: &mut Value, child: usize) {
    match &mut parent["children"] {
        Value::Array(children) => children.push(child.into()),
        children => *children = json!([child]),
    }
}
