//! The tree of nodes that a model came with, and the parts of the mesh that its nodes placed.

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
}

/// An instance of a mesh: what one node placed.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    /// Index into [`Tree::nodes`], another one for each part.
    pub node: u32,
    /// Name of the mesh in the source file, may be empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub mesh: String,
}

/// Nodes and the parts that they placed. Empty for formats without nodes.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tree {
    /// Parents come before their children.
    pub nodes: Vec<Node>,
    /// What triangles refer to.
    pub parts: Vec<Part>,
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
            && self.nodes.iter().all(is_bare)
            && self.parts.iter().all(|part| part.mesh.is_empty())
    }
}
