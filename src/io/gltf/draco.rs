//! Primitives compressed by Draco (KHR_draco_mesh_compression), decoded whole: triangles and the
//! attributes that the extension names.
//!
//! How many points and triangles there are is what the compressed data says, as other readers take it,
//! not what accessors say. The decoder is the crate `draco-core`, without C++ and without `unsafe`.

use std::{collections::BTreeMap, panic::catch_unwind};

use draco_core::{DecodeLimits, DecoderBuffer, FaceIndex, Mesh, MeshDecoder};
use gltf::json::accessor::ComponentType;
use serde::Deserialize;

use super::{Document, IoError, REMEDY, accessor::View};

/// A mesh's primitives with their extensions, as far as they matter here.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Carrier {
    primitives: Vec<Primitive>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Primitive {
    extensions: Extensions,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Extensions {
    #[serde(rename = "KHR_draco_mesh_compression")]
    draco: Option<Compression>,
}

/// Where the compressed bytes are, and under which numbers attributes are in them.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Compression {
    buffer_view: usize,
    #[serde(default)]
    attributes: BTreeMap<String, u32>,
}

/// A decoded primitive.
pub(super) struct Packed<'d> {
    mesh: Mesh,
    numbers: &'d BTreeMap<String, u32>,
}

impl<'d> Packed<'d> {
    /// Decodes primitive `number` of `mesh`; `None` when it is not compressed.
    pub(super) fn of(
        document: &'d Document<'_>,
        mesh: usize,
        number: usize,
        place: &str,
    ) -> Result<Option<Self>, IoError> {
        let primitive = document.compressed.get(mesh).and_then(|m| m.primitives.get(number));
        let Some(compression) = primitive.and_then(|p| p.extensions.draco.as_ref()) else {
            return Ok(None);
        };
        let place = format!("{place}, Draco data");
        let source = document.source;
        let bytes =
            document.buffers.view(source, &document.root, compression.buffer_view, &place)?;
        let limits = DecodeLimits::default()
            .with_max_points(source.limits.max_vertices)
            .with_max_faces(source.limits.max_triangles)
            .with_max_decoded_bytes(source.limits.max_bytes);
        // A decoder that panics cannot decode: arithmetic is checked here, which its authors need not have tried.
        let decoded = catch_unwind(|| {
            let mut mesh = Mesh::new();
            let mut buffer = DecoderBuffer::new(bytes).with_limits(limits);
            MeshDecoder::new().decode(&mut buffer, &mut mesh).map(|()| mesh)
        });
        let problem = match decoded {
            Ok(Ok(mesh)) => return Ok(Some(Self { mesh, numbers: &compression.attributes })),
            Ok(Err(error)) => error.to_string(),
            Err(_) => "the decoder failed".to_owned(),
        };
        let problem: String = problem.chars().take(200).collect();
        Err(source.malformed(place, format!("it cannot be decoded ({problem})"), REMEDY))
    }

    pub(super) fn n_points(&self) -> usize {
        self.mesh.num_points()
    }

    pub(super) fn n_corners(&self) -> usize {
        3 * self.mesh.num_faces()
    }

    /// The points of all corners: a list of triangles.
    pub(super) fn corners(&self) -> Vec<u32> {
        let face = |i: usize| self.mesh.face(FaceIndex(i as u32)).map(|point| point.0);
        (0..self.mesh.num_faces()).flat_map(face).collect()
    }

    /// The values of an attribute for all points; `None` when it is not in the compressed data. The
    /// accessor says how many a point has, and whether integers are normalized.
    pub(super) fn floats(&self, name: &str, view: &View<'_>, normalize: bool) -> Option<Vec<f32>> {
        let attribute = self.mesh.attribute_by_unique_id(*self.numbers.get(name)?)?;
        let mut values = attribute.read_f32s(self.n_points(), view.width);
        if normalize || view.accessor.normalized {
            let (scale, least) = normalization(view.component);
            values.iter_mut().for_each(|v| *v = (*v / scale).max(least));
        }
        Some(values)
    }
}

/// What integers are divided by, and the least that comes of it (glTF 2.0 §3.11).
fn normalization(component: ComponentType) -> (f32, f32) {
    match component {
        ComponentType::I8 => (127.0, -1.0),
        ComponentType::U8 => (255.0, 0.0),
        ComponentType::I16 => (32_767.0, -1.0),
        ComponentType::U16 => (65_535.0, 0.0),
        ComponentType::U32 => (4_294_967_295.0, 0.0),
        ComponentType::F32 => (1.0, f32::MIN),
    }
}
