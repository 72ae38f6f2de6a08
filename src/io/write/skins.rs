//! Skins: joints as nodes with transforms, inverse bind matrices, and what moves each vertex.
//!
//! Joints, and the nodes above them, are at the top of the scene and there once, also where several levels are in the
//! file. Meshes that move are not below them: what is above such a mesh does not move it (glTF 2.0 §3.7.3.3).
//! The grid of quantized positions is undone by the inverse bind matrices.

use serde_json::{Map, Value, json};

use super::{
    IoError,
    columns::{Grid, joints, shares},
    nodes::add_child,
    store::Store,
};
use crate::mesh::{
    Skin, Tree,
    skin::{self, MAX_JOINTS},
};

/// What is in the file.
#[derive(Default)]
pub(super) struct Skins {
    /// Nodes at the top.
    pub(super) roots: Vec<usize>,
    pub(super) values: Vec<Value>,
}

/// What moves a part.
pub(super) struct SkinOfPart<'t> {
    /// Index into the file's skins.
    pub(super) index: usize,
    skin: &'t Skin,
}

/// Adds the joints of a tree to the nodes and its skins to the store; nothing where one of them is not sound, as in a
/// damaged file.
pub(super) fn put_skins(
    nodes: &mut Vec<Value>,
    store: &mut Store,
    tree: &Tree,
    grid: Option<&Grid>,
) -> Skins {
    let is_sound = |skin: &Skin| {
        let mut all = skin.joints.iter().chain(&skin.skeleton);
        let has = |j: &u32| tree.nodes.get(*j as usize).is_some_and(|n| n.transform.is_some());
        !skin.joints.is_empty() && skin.joints.len() == skin.joint_from_world.len() && all.all(has)
    };
    let mut skins = Skins::default();
    if tree.skins.is_empty() || !tree.skins.iter().all(is_sound) {
        return skins;
    }
    let mut new_ids: Vec<Option<usize>> = vec![None; tree.nodes.len()];
    for (at, node) in tree.nodes.iter().enumerate() {
        let Some(transform) = &node.transform else { continue };
        let own = nodes.len();
        new_ids[at] = Some(own);
        match tree.parent(at as u32).and_then(|parent| new_ids[parent as usize]) {
            Some(parent) => add_child(&mut nodes[parent], own),
            None => skins.roots.push(own),
        }
        nodes.push(named(Value::Object(transform.clone()), &node.name));
    }
    let new = |node: &u32| new_ids[*node as usize];
    for skin in &tree.skins {
        let matrices: Vec<[f32; 16]> = skin
            .joint_from_world
            .iter()
            .map(|matrix| grid.map_or(*matrix, |grid| grid.put_before(matrix)).map(|x| x as f32))
            .collect();
        let mut value = json!({
            "joints": skin.joints.iter().filter_map(new).collect::<Vec<_>>(),
            "inverseBindMatrices": store.matrices(&matrices),
        });
        if let Some(skeleton) = skin.skeleton.as_ref().and_then(new) {
            value["skeleton"] = skeleton.into();
        }
        skins.values.push(named(value, &skin.name));
    }
    skins
}

fn named(mut value: Value, name: &str) -> Value {
    if !name.is_empty() {
        value["name"] = name.into();
    }
    value
}

impl Skins {
    /// The skin of a part, if it has one and that is in the file.
    pub(super) fn of_part<'t>(&self, tree: &'t Tree, part: usize) -> Option<SkinOfPart<'t>> {
        let index = tree.parts.get(part)?.skin? as usize;
        let skin = tree.skins.get(index).filter(|_| index < self.values.len())?;
        Some(SkinOfPart { index, skin })
    }
}

impl SkinOfPart<'_> {
    /// Joints and their shares for each point, by the names of their attributes.
    pub(super) fn put_attributes<'v>(
        &self,
        store: &mut Store,
        values: impl Iterator<Item = &'v [f32]>,
    ) -> Result<Map<String, Value>, IoError> {
        let is_quantized = store.options.quantize;
        let (mut numbers, mut parts) = (Vec::new(), Vec::new());
        for values in values {
            let (own, their) = self.of_point(values);
            numbers.extend(own);
            parts.extend(if is_quantized { to_steps(their) } else { their });
        }
        let numbers = store.fours(&numbers, joints(self.skin.joints.len()))?;
        let parts = store.fours(&parts, shares(is_quantized))?;
        let rows = [("JOINTS_0", numbers), ("WEIGHTS_0", parts)];
        Ok(rows.into_iter().map(|(name, accessor)| (name.to_owned(), accessor.into())).collect())
    }

    /// Joints in the skin's own numbers, and their shares. A vertex that none of them moves goes with the first.
    fn of_point(&self, values: &[f32]) -> ([f32; MAX_JOINTS], [f32; MAX_JOINTS]) {
        let numbers = self.skin.numbers();
        let own = skin::shares(values).filter(|(joint, _)| numbers.contains(joint));
        let found = skin::settled(own.map(|(joint, share)| (joint - numbers.start, share)));
        let mut joints = [0.0; MAX_JOINTS];
        let mut shares = [0.0; MAX_JOINTS];
        joints.copy_from_slice(&found[..MAX_JOINTS]);
        shares.copy_from_slice(&found[MAX_JOINTS..]);
        if shares[0] == 0.0 {
            shares[0] = 1.0;
        }
        (joints, shares)
    }
}

/// Shares in whole steps of 16 bits, which add up to 65,535: rounded down, but for the largest, which takes the rest.
fn to_steps(shares: [f32; MAX_JOINTS]) -> [f32; MAX_JOINTS] {
    let mut steps = shares.map(|share| (share * 65_535.0).floor());
    steps[0] = 65_535.0 - steps[1..].iter().sum::<f32>();
    steps.map(|n| n / 65_535.0)
}
