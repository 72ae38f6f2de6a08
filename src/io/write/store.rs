//! The binary chunk of a GLB and the tables that describe it.
//!
//! Each accessor has a buffer view of its own. Views begin at multiples of four bytes. Compressed
//! views (EXT_meshopt_compression) have their place, uncompressed, in a second buffer, which is not
//! in the file. That extension knows version 0 of the vertex codec.

use glam::Vec3;
use serde_json::{Value, json};

use super::{
    IoError,
    columns::{FLOAT, Grid, Number, STEPS, column, quantized},
    glb::GlbOptions,
    points::Points,
};
use crate::mesh::{Mesh, Semantic};

pub(super) const MESHOPT: &str = "EXT_meshopt_compression";
const ARRAY_BUFFER: u32 = 34_962;
const ELEMENT_ARRAY_BUFFER: u32 = 34_963;
const UNSIGNED_SHORT: u32 = 5_123;
const UNSIGNED_INT: u32 = 5_125;

/// See the module.
pub(super) struct Store {
    pub(super) options: GlbOptions,
    pub(super) bin: Vec<u8>,
    pub(super) views: Vec<Value>,
    pub(super) accessors: Vec<Value>,
    /// Bytes of the second buffer.
    n_unpacked: usize,
}

/// What a buffer view holds.
enum Content<'a> {
    /// Indices of triangles, and of how many points.
    Triangles(&'a [u32], usize),
    /// So many bytes for each vertex.
    Vertices(usize),
}

impl Store {
    pub(super) fn new(options: GlbOptions) -> Self {
        let quantize = options.quantize || options.compress;
        let options = GlbOptions { quantize, ..options };
        Self { options, bin: Vec::new(), views: Vec::new(), accessors: Vec::new(), n_unpacked: 0 }
    }

    /// 16-bit indices where they suffice; 65,535 is reserved for restarts.
    pub(super) fn indices(&mut self, points: &Points) -> Result<usize, IoError> {
        let flat = points.triangles.as_flattened();
        let (component, bytes): (u32, Vec<u8>) = if u16::try_from(points.len()).is_ok() {
            (UNSIGNED_SHORT, flat.iter().flat_map(|i| (*i as u16).to_le_bytes()).collect())
        } else {
            (UNSIGNED_INT, flat.iter().flat_map(|i| i.to_le_bytes()).collect())
        };
        let content = Content::Triangles(flat, points.len());
        let accessor = json!({
            "bufferView": self.values(&bytes, &content)?,
            "componentType": component,
            "count": flat.len(),
            "type": "SCALAR",
        });
        Ok(self.push_accessor(accessor))
    }

    /// On the grid, or from its origin, if there is one.
    pub(super) fn positions(
        &mut self,
        mesh: &Mesh,
        points: &Points,
        grid: Option<&Grid>,
    ) -> Result<usize, IoError> {
        let place = |p| match grid {
            Some(grid) => Vec3::from_array(grid.steps(p)),
            None => p.as_vec3(),
        };
        let positions: Vec<Vec3> = points.positions(mesh).map(place).collect();
        let first = positions.first().copied().unwrap_or(Vec3::ZERO);
        let (min, max) =
            positions.iter().fold((first, first), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
        let values: Vec<f32> = positions.iter().flat_map(Vec3::to_array).collect();
        let number = if self.options.quantize { &STEPS } else { &FLOAT };
        let mut accessor = self.accessor(&values, 3, number)?;
        accessor["min"] = json!(min.to_array());
        accessor["max"] = json!(max.to_array());
        Ok(self.push_accessor(accessor))
    }

    /// Values of one to four for each point.
    pub(super) fn attribute(
        &mut self,
        semantic: Semantic,
        values: &[f32],
        width: usize,
    ) -> Result<usize, IoError> {
        let is_quantized = self.options.quantize;
        let number = if is_quantized { quantized(semantic, values) } else { &FLOAT };
        let accessor = self.accessor(values, width, number)?;
        Ok(self.push_accessor(accessor))
    }

    /// Values of four for each point, in numbers of a kind.
    pub(super) fn fours(&mut self, values: &[f32], number: &Number) -> Result<usize, IoError> {
        let accessor = self.accessor(values, 4, number)?;
        Ok(self.push_accessor(accessor))
    }

    /// Matrices, column by column.
    pub(super) fn matrices(&mut self, matrices: &[[f32; 16]]) -> usize {
        let bytes: Vec<u8> = matrices.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
        let accessor = json!({
            "bufferView": self.view(&bytes),
            "componentType": FLOAT.component,
            "count": matrices.len(),
            "type": "MAT4",
        });
        self.push_accessor(accessor)
    }

    fn accessor(
        &mut self,
        values: &[f32],
        width: usize,
        number: &Number,
    ) -> Result<Value, IoError> {
        let (bytes, stride) = column(values, width, number);
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1];
        let mut accessor = json!({
            "bufferView": self.values(&bytes, &Content::Vertices(stride))?,
            "componentType": number.component,
            "count": values.len() / width,
            "type": kind,
        });
        if number.normalized {
            accessor["normalized"] = true.into();
        }
        Ok(accessor)
    }

    fn push_accessor(&mut self, accessor: Value) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    /// A view of indices or attributes.
    fn values(&mut self, bytes: &[u8], content: &Content<'_>) -> Result<usize, IoError> {
        let compressed = if self.options.compress { Some(compress(bytes, content)?) } else { None };
        let view = self.view(compressed.as_deref().unwrap_or(bytes));
        let (target, stride) = match content {
            Content::Triangles(..) => (ELEMENT_ARRAY_BUFFER, None),
            Content::Vertices(stride) => (ARRAY_BUFFER, Some(*stride)),
        };
        if compressed.is_some() {
            self.set_aside(view, bytes.len(), content);
        }
        let value = &mut self.views[view];
        value["target"] = target.into();
        // Elements of singles follow each other without a stride.
        if let Some(stride) = stride.filter(|_| self.options.quantize) {
            value["byteStride"] = stride.into();
        }
        Ok(view)
    }

    /// Bytes as they are; images are views without a target.
    pub(super) fn view(&mut self, bytes: &[u8]) -> usize {
        let offset = self.bin.len();
        self.bin.extend_from_slice(bytes);
        // The padding belongs to no view.
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        self.views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() }));
        self.views.len() - 1
    }

    /// Makes a view of compressed bytes one of `n_bytes` in the second buffer.
    fn set_aside(&mut self, view: usize, n_bytes: usize, content: &Content<'_>) {
        let (mode, count, stride) = match content {
            Content::Triangles(indices, _) => ("TRIANGLES", indices.len(), n_bytes / indices.len()),
            Content::Vertices(stride) => ("ATTRIBUTES", n_bytes / stride, *stride),
        };
        let mut packed = self.views[view].take();
        packed["byteStride"] = stride.into();
        packed["count"] = count.into();
        packed["mode"] = mode.into();
        self.views[view] = json!({
            "buffer": 1,
            "byteOffset": self.n_unpacked,
            "byteLength": n_bytes,
            "extensions": { MESHOPT: packed },
        });
        self.n_unpacked += n_bytes.next_multiple_of(4);
    }

    /// The chunk, and the place of what is compressed.
    pub(super) fn buffers(&self) -> Value {
        let chunk = json!({ "byteLength": self.bin.len() });
        if self.n_unpacked == 0 {
            return json!([chunk]);
        }
        let extensions = json!({ MESHOPT: { "fallback": true } });
        json!([chunk, { "byteLength": self.n_unpacked, "extensions": extensions }])
    }
}

fn compress(bytes: &[u8], content: &Content<'_>) -> Result<Vec<u8>, IoError> {
    match content {
        Content::Triangles(indices, n) => meshopt::encode_index_buffer(indices, *n),
        Content::Vertices(stride) => match stride {
            4 => vertices::<4>(bytes),
            8 => vertices::<8>(bytes),
            12 => vertices::<12>(bytes),
            _ => vertices::<16>(bytes),
        },
    }
    .map_err(|e| IoError::Unwritable { format: "GLB", problem: format!("compression failed: {e}") })
}

/// `meshopt` takes the stride from the type.
fn vertices<const N: usize>(bytes: &[u8]) -> meshopt::Result<Vec<u8>> {
    const LEVEL: i32 = 2;
    const VERSION: i32 = 0;
    meshopt::encode_vertex_buffer_level(bytes.as_chunks::<N>().0, LEVEL, Some(VERSION))
}
