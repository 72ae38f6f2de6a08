//! Seeds of the GLB reader: each way in which geometry and images can be packed.

use std::io::Cursor;

use image::{ImageFormat, Rgb, RgbImage};
use lookalike::io::{self, GlbLevel, GlbOptions};
use meshopt::{
    EncodeExpMode, encode_filter_color, encode_filter_exp, encode_filter_oct, encode_filter_quat,
    encode_index_sequence, encode_vertex_buffer_level,
};
use serde_json::{Value, json};

use crate::{document::pack, octahedron};

/// By the formats' own encoders: `src/io/tests/fixtures/README.md` of the main package.
const DRACO: [&[u8]; 2] = [
    include_bytes!("../../src/io/tests/fixtures/draco_edgebreaker.glb"),
    include_bytes!("../../src/io/tests/fixtures/draco_sequential.glb"),
];
const KTX2: [&[u8]; 2] = [
    include_bytes!("../../src/io/tests/fixtures/etc1s.ktx2"),
    include_bytes!("../../src/io/tests/fixtures/uastc.ktx2"),
];
const MESHOPT: &str = "KHR_meshopt_compression";

pub fn seeds() -> Vec<Vec<u8>> {
    written()
        .chain(DRACO.map(<[u8]>::to_vec))
        .chain(KTX2.map(|bytes| textured("KHR_texture_basisu", bytes)))
        .chain(images())
        .chain([filtered(), assembly(), skinned()])
        .collect()
}

/// By the writer: plain, quantized, compressed, two levels.
fn written() -> impl Iterator<Item = Vec<u8>> {
    let mesh = octahedron();
    let level = |name, screen_coverage| GlbLevel { name, mesh: &mesh, screen_coverage };
    let both = io::write_lods(&[level("a", 0.5), level("b", 0.0)], GlbOptions::default());
    [(false, false), (true, false), (true, true)]
        .map(|(quantize, compress)| GlbOptions { quantize, compress })
        .map(|options| io::write_glb_with(&mesh, options))
        .into_iter()
        .chain([both])
        .flatten()
}

/// Images of each format that the core of glTF or an extension knows.
fn images() -> impl Iterator<Item = Vec<u8>> {
    [(ImageFormat::Png, ""), (ImageFormat::Jpeg, ""), (ImageFormat::WebP, "EXT_texture_webp")]
        .map(|(format, extension)| textured(extension, &picture(format)))
        .into_iter()
}

pub fn png() -> Vec<u8> {
    picture(ImageFormat::Png)
}

fn picture(format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let picture = RgbImage::from_fn(9, 5, |x, y| Rgb([20 * x as u8, 50 * y as u8, 128]));
    picture.write_to(&mut bytes, format).map(|()| bytes.into_inner()).unwrap_or_default()
}

/// Text of a glTF and the buffer that it names.
pub fn apart() -> (Vec<u8>, Vec<u8>) {
    let File { mut json, bin } = File::square();
    json["buffers"][0] = json!({ "byteLength": bin.len(), "uri": "a.bin" });
    (json.to_string().into_bytes(), bin)
}

/// A square that shows an image, by an extension or, unnamed, without one.
fn textured(extension: &str, image: &[u8]) -> Vec<u8> {
    let mut file = File::square();
    file.attribute("TEXCOORD_0", 5126, "VEC2", &floats(&[0., 0., 2., 0., 0., 2., 2., 2.]), 8);
    let view = file.view(image);
    let moved = json!({ "offset": [0.5, 0], "rotation": 0.25, "scale": [2, -1] });
    file.json["extensionsUsed"] = json!(["KHR_texture_transform"]);
    file.json["images"] = json!([{ "bufferView": view }]);
    file.json["samplers"] = json!([{ "wrapS": 33071, "wrapT": 33648, "minFilter": 9987 }]);
    let mut texture = json!({ "sampler": 0 });
    if extension.is_empty() {
        texture["source"] = 0.into();
    } else {
        file.json["extensionsRequired"] = json!([extension]);
        texture["extensions"] = json!({ extension: { "source": 0 } });
    }
    file.json["textures"] = json!([texture]);
    file.json["materials"] = json!([{ "alphaMode": "MASK", "alphaCutoff": 0.25,
        "doubleSided": true, "emissiveFactor": [0.5, 0, 1], "emissiveTexture": { "index": 0 },
        "extensions": { "KHR_materials_emissive_strength": { "emissiveStrength": 2 } },
        "pbrMetallicRoughness": { "baseColorFactor": [1, 0.5, 1, 0.5],
            "baseColorTexture": { "index": 0, "extensions": { "KHR_texture_transform": moved } } } }]);
    file.primitive()["material"] = 0.into();
    file.finish()
}

/// A compressed view for each filter, and indices as they come.
fn filtered() -> Vec<u8> {
    fn bytes<T>(elements: &[T]) -> (Vec<u8>, usize) {
        (encode_vertex_buffer_level(elements, 2, Some(1)).unwrap_or_default(), size_of::<T>())
    }
    let corners = [[0.0, 0.0, 0.0_f32], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
    let positions = encode_filter_exp(&corners, 15, EncodeExpMode::SharedVector);
    let normals = encode_filter_oct::<i8>(&[[0.0, 0.0, -1.0, 0.0]; 4], 8);
    let turns = encode_filter_quat(&[[0.0, 1.0, 0.0, 0.0]; 4], 12);
    let colours = encode_filter_color::<u16>(&[[1.0, 0.0, 0.5, 1.0]; 4], 12);
    let indices = encode_index_sequence(&[0, 1, 2, 2, 1, 3], 4).unwrap_or_default();
    let mut file = File { json: document(), bin: Vec::new() };
    for (k, ((bytes, stride), filter, name, component, kind)) in [
        (bytes(&positions), "EXPONENTIAL", "POSITION", 5126, "VEC3"),
        (bytes(&normals), "OCTAHEDRAL", "NORMAL", 5120, "VEC3"),
        (bytes(&turns), "QUATERNION", "COLOR_0", 5122, "VEC4"),
        (bytes(&colours), "COLOR", "COLOR_1", 5123, "VEC4"),
        ((indices, 4), "NONE", "", 5125, "SCALAR"),
    ]
    .into_iter()
    .enumerate()
    {
        let (mode, count) = if name.is_empty() { ("INDICES", 6) } else { ("ATTRIBUTES", 4) };
        file.attribute(name, component, kind, &bytes, stride);
        let mut packed = file.json["bufferViews"][k].take();
        packed["count"] = count.into();
        packed["mode"] = mode.into();
        packed["filter"] = filter.into();
        packed["byteStride"] = stride.into();
        file.json["bufferViews"][k] = json!({ "buffer": 1, "byteLength": stride * count,
            "extensions": { MESHOPT: packed } });
        file.json["accessors"][k]["count"] = count.into();
    }
    file.json["extensionsRequired"] = json!([MESHOPT, "KHR_mesh_quantization"]);
    file.json["buffers"] =
        json!([{}, { "byteLength": 1000, "extensions": { MESHOPT: { "fallback": true } } }]);
    file.finish()
}

/// Nodes below nodes, a matrix, colours, other positions in a few places (a sparse accessor).
fn assembly() -> Vec<u8> {
    let mut file = File::square();
    file.attribute(
        "COLOR_0",
        5121,
        "VEC3",
        &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15],
        4,
    );
    let (which, values) = (file.view(&[3, 0, 0, 0]), file.view(&floats(&[1., 1., 0.5])));
    file.json["accessors"][0]["sparse"] = json!({ "count": 1,
        "indices": { "bufferView": which, "componentType": 5121 },
        "values": { "bufferView": values } });
    file.json["scenes"] = json!([{ "nodes": [0] }]);
    file.json["nodes"] = json!([
        { "name": "ship", "children": [1, 2], "translation": [10, 0, 0] },
        { "name": "mast", "children": [3], "scale": [2, 2, 2] },
        { "mesh": 0, "matrix": [0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 3, 0, 0, 1] },
        { "name": "sail", "mesh": 0, "rotation": [0, 0, 1, 0] },
    ]);
    file.finish()
}

/// Two joints that move a square, and one without a skin that hangs from the second.
fn skinned() -> Vec<u8> {
    let mut file = File::square();
    file.attribute("JOINTS_0", 5121, "VEC4", &[0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 1, 0, 0], 4);
    file.json["accessors"][2]["normalized"] = false.into();
    let shares = [0.75, 0.25, 0., 0., 1., 0., 0., 0., 0.5, 0., 0., 0., 0.5, 0.5, 0., 0.];
    file.attribute("WEIGHTS_0", 5126, "VEC4", &floats(&shares), 16);
    let matrix = |x| [2., 0., 0., 0., 0., 2., 0., 0., 0., 0., 2., 0., x, 0., 0., 1.];
    file.attribute("_MATRICES", 5126, "MAT4", &floats(&[matrix(0.0), matrix(-1.0)].concat()), 64);
    file.primitive()["attributes"].as_object_mut().map(|all| all.remove("_MATRICES"));
    let held = json!({ "primitives": [{ "attributes": { "POSITION": 0 } }] });
    file.json["meshes"] = json!([file.json["meshes"][0], held]);
    file.json["skins"] = json!([{ "joints": [1, 2], "inverseBindMatrices": 4, "skeleton": 1 }]);
    file.json["nodes"] = json!([
        { "children": [1, 4], "scale": [0.5, 0.5, 0.5] },
        { "children": [2] },
        { "translation": [1, 0, 0], "children": [3] },
        { "mesh": 1 },
        { "mesh": 0, "skin": 0 },
    ]);
    file.finish()
}

/// A file under construction: all it shows is one primitive.
struct File {
    json: Value,
    bin: Vec<u8>,
}

fn document() -> Value {
    json!({
        "asset": { "version": "2.0" },
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": {} }] }],
        "accessors": [],
        "bufferViews": [],
        "buffers": [{}],
    })
}

impl File {
    /// The unit square of two triangles.
    fn square() -> Self {
        let mut file = Self { json: document(), bin: Vec::new() };
        let corners = floats(&[0., 0., 0., 1., 0., 0., 0., 1., 0., 1., 1., 0.]);
        file.attribute("POSITION", 5126, "VEC3", &corners, 12);
        file.attribute("", 5121, "SCALAR", &[0, 1, 2, 2, 1, 3], 1);
        file
    }

    fn primitive(&mut self) -> &mut Value {
        &mut self.json["meshes"][0]["primitives"][0]
    }

    /// A view, its accessor and its use: indices have no name.
    fn attribute(&mut self, name: &str, component: u32, kind: &str, bytes: &[u8], stride: usize) {
        let view = self.view(bytes);
        let accessor = json!({ "bufferView": view, "componentType": component, "type": kind,
            "count": bytes.len() / stride, "normalized": name != "POSITION" && !name.is_empty() });
        if !name.is_empty() {
            self.json["bufferViews"][view]["byteStride"] = stride.into();
        }
        let accessors = self.json["accessors"].as_array_mut();
        let id = accessors.map_or(0, |all| (all.push(accessor), all.len() - 1).1);
        match name {
            "" => self.primitive()["indices"] = id.into(),
            name => self.primitive()["attributes"][name] = id.into(),
        }
    }

    fn view(&mut self, bytes: &[u8]) -> usize {
        let view = json!({ "buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len() });
        self.bin.extend(bytes);
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        self.json["bufferViews"].as_array_mut().map_or(0, |all| (all.push(view), all.len() - 1).1)
    }

    fn finish(mut self) -> Vec<u8> {
        self.json["buffers"][0]["byteLength"] = self.bin.len().into();
        pack(&self.json, &self.bin)
    }
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}
