//! The tree of nodes that a model came with, the parts of the mesh that its nodes placed, and the skins that
//! move them.

use serde::{Deserialize, Serialize};

/// A node of the tree.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Node {
    /// Name in the source file, may be empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub name: String,
    /// Index of the node above, which is lower; `None` at the top. One that is not lower counts as
    /// none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parent: Option<u32>,
    /// glTF's `translation`, `rotation`, `scale` or `matrix`, word for word, of a joint and of what is above one.
    /// Others have none: their geometry is in world space.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transform: Option<serde_json::Map<String, serde_json::Value>>,
}

/// An instance of a mesh: what one node placed.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    /// Index into [`Tree::nodes`], another one for each part.
    pub node: u32,
    /// Name of the mesh in the source file, may be empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub mesh: String,
    /// Index into [`Tree::skins`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub skin: Option<u32>,
}

/// Joints that move vertices: where a vertex has share `w` of joint `j`, `world_from_node[j] joint_from_world[j] w` of
/// it goes along (glTF 2.0 §3.7.3.1).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Skin {
    /// Name in the source file, may be empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub name: String,
    /// The number that wedges know its first joint by; the others follow ([`Semantic::Skin`](super::Semantic)).
    pub first_joint: u32,
    /// Indices into [`Tree::nodes`].
    pub joints: Vec<u32>,
    /// Inverse bind matrices, column by column, as many as joints.
    pub joint_from_world: Vec<[f64; 16]>,
    /// The joints' common root, as the file names it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub skeleton: Option<u32>,
}

impl Skin {
    /// The numbers of its joints.
    pub fn numbers(&self) -> std::ops::Range<u32> {
        self.first_joint..self.first_joint.saturating_add(self.joints.len() as u32)
    }
}

/// Nodes and the parts that they placed. Empty for formats without nodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Tree {
    /// Parents come before their children.
    pub nodes: Vec<Node>,
    /// What triangles refer to.
    pub parts: Vec<Part>,
    /// What parts refer to.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub skins: Vec<Skin>,
}

impl Tree {
    /// The node above.
    pub fn parent(&self, node: u32) -> Option<u32> {
        self.nodes.get(node as usize)?.parent.filter(|parent| *parent < node)
    }

    /// What people call a part: its node's name, else its mesh's, else a number.
    pub fn part_name(&self, part: u32) -> String {
        let found = self.parts.get(part as usize);
        let node = found.and_then(|p| self.nodes.get(p.node as usize)).map(|n| n.name.as_str());
        let names = [node, found.map(|p| p.mesh.as_str())];
        let name = names.into_iter().flatten().find(|name| !name.is_empty());
        name.map_or_else(|| format!("part {part}"), str::to_owned)
    }

    /// One node at the top, all without names: what a mesh without a tree is written as.
    pub fn says_nothing(&self) -> bool {
        let is_bare = |node: &Node| node.name.is_empty() && node.parent.is_none();
        self.nodes.len() <= 1
            && self.skins.is_empty()
            && self.nodes.iter().all(is_bare)
            && self.parts.iter().all(|part| part.mesh.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Trees come from files, too: what is no transform must not get as far as a writer.
    #[test]
    fn a_transform_is_an_object() {
        for (transform, is_one) in [("{}", true), ("5", false), ("[1]", false), ("\"x\"", false)] {
            let text = format!(r#"{{"nodes": [{{"transform": {transform}}}], "parts": []}}"#);
            assert_eq!(serde_json::from_str::<Tree>(&text).is_ok(), is_one, "{transform}");
        }
    }
}
