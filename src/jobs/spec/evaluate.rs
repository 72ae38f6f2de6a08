//! The part of a specification that says how two meshes are compared.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Fault, Metric, Shading, Spec};

/// How much the simplified mesh looks like the original: pictures in 24 views that no job works with, and distances.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(clippy::struct_excessive_bools, reason = "independent flags of a comparison")]
pub struct Evaluate {
    /// Flat or smooth.
    pub shading: Shading,
    /// Material and vertex colours are drawn instead of white.
    pub colours: bool,
    /// Back faces of single-sided materials are left out.
    pub hide_back_faces: bool,
    /// In smooth shading, the simplified mesh is drawn with the normals of its file.
    pub stored_normals: bool,
    /// The distance between the surfaces is measured too.
    pub distance: bool,
    /// By what pictures are compared.
    #[serde(skip_serializing_if = "Metric::is_luminance")]
    pub metric: Metric,
}

impl Default for Evaluate {
    fn default() -> Self {
        Self {
            shading: Shading::default(),
            colours: false,
            hide_back_faces: false,
            stored_normals: false,
            distance: true,
            metric: Metric::default(),
        }
    }
}

impl Spec {
    /// Whatever would change a mesh, or the pictures that such work looks at, has no place in an evaluation.
    pub(super) fn validate_evaluation(&self, faults: &mut Vec<Fault>) {
        if self.simplified.is_none() {
            let text = "two meshes are compared: name the second one".into();
            faults.push(Fault { field: "simplified".into(), text });
        }
        // Both are plain data, which is always JSON.
        let [asked, plain] = [self, &Self::new(Vec::new())]
            .map(|spec| serde_json::to_value(spec).unwrap_or_default());
        strays(&asked, &plain, "", faults);
    }
}

/// Fields with other values than those that they have where nobody gives them any.
fn strays(asked: &Value, plain: &Value, within: &str, faults: &mut Vec<Fault>) {
    let (Value::Object(asked), Value::Object(plain)) = (asked, plain) else { return };
    for (name, value) in asked {
        let field = format!("{within}{name}");
        match plain.get(name) {
            _ if ["simplified", "evaluate"].contains(&&*field) => {}
            Some(known) if known == value => {}
            Some(known @ Value::Object(_)) => strays(value, known, &format!("{field}."), faults),
            _ => {
                let text = "an evaluation takes both meshes as they are: leave this out".into();
                faults.push(Fault { field, text });
            }
        }
    }
}
