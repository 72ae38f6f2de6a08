// What every kernel shares: parameters, the packed triangle, and the fragment lists' addresses.
//
// Integers only. All floating point was done on the host; arithmetic is modulo 2^32 as in
// lattice.rs, so every adapter gives the same bits.
//
// A fragment's address: layer * n_pixels + pixel for the first N_LAYERS fragments of a pixel, then
// pool addresses from N_LAYERS * n_pixels on, chained through `links`. Lists end at the first
// NO_FACE; storage behind it stays with the pixel for later use.

const N_LAYERS: u32 = 4u;
const MAX_DEPTH: u32 = 60000u;
const NIL: u32 = 0xffffffffu;
const NO_FACE: u32 = 0xfffffffeu;
const OUTSIDE: u32 = 0xffffffffu;
const WORKGROUP: u32 = 64u;

struct Params {
    first_item: u32,
    n_items: u32,
    output_at: u32,
    row_stride: u32,
    n_pixels: u32,
    n_addresses: u32,
    size: i32,
    first_center: i32,
    sub_bits: u32,
    background: u32,
    first_pixel: u32,
    n_nodes: u32,
}
var<immediate> params: Params;

@group(1) @binding(0) var<storage, read> input: array<vec4<u32>>;
@group(1) @binding(1) var<storage, read_write> output: array<u32>;

// at_origin + i dx + j dy as (at_origin, dx, dy).
struct Triangle {
    edge_a: vec3<i32>,
    edge_b: vec3<i32>,
    edge_c: vec3<i32>,
    depth: vec3<i32>,
    low: vec2<i32>,
    high: vec2<i32>,
    face: u32,
}

// The item of this invocation; n_items or more when there is none.
fn item_index(id: vec3<u32>, n_groups: vec3<u32>) -> u32 {
    return id.x + id.y * n_groups.x * WORKGROUP;
}

fn corner(packed: u32) -> vec2<i32> {
    return vec2<i32>(i32(packed & 0xffffu), i32(packed >> 16u));
}

fn edge(a: vec2<i32>, b: vec2<i32>) -> vec3<i32> {
    let d = b - a;
    let owns_ties = d.y < 0 || (d.y == 0 && d.x > 0);
    let at = d.x * (params.first_center - a.y) - d.y * (params.first_center - a.x);
    return vec3<i32>(at - select(1, 0, owns_ties), -(d.y << params.sub_bits), d.x << params.sub_bits);
}

fn load_triangle(at: u32) -> Triangle {
    let corners = input[at];
    let plane = input[at + 1u];
    let a = corner(corners.x);
    let b = corner(corners.y);
    let c = corner(corners.z);
    var t: Triangle;
    t.edge_a = edge(a, b);
    t.edge_b = edge(b, c);
    t.edge_c = edge(c, a);
    t.depth = bitcast<vec3<i32>>(plane.xyz);
    t.face = plane.w;
    let up = (1 << params.sub_bits) - 1;
    let center = vec2<i32>(params.first_center);
    let shift = vec2<u32>(params.sub_bits);
    t.low = max((min(min(a, b), c) - center + up) >> shift, vec2<i32>(0));
    t.high = min((max(max(a, b), c) - center) >> shift, vec2<i32>(params.size - 1));
    return t;
}

fn at_pixel(plane: vec3<i32>, i: i32, j: i32) -> i32 {
    return plane.x + plane.y * i + plane.z * j;
}

fn covers(t: Triangle, i: i32, j: i32) -> bool {
    return (at_pixel(t.edge_a, i, j) | at_pixel(t.edge_b, i, j) | at_pixel(t.edge_c, i, j)) >= 0;
}

// 16-bit depth << 16 of a covered pixel: the host scaled the plane to 16 fraction bits. Clamping to
// the corners' range, as lattice.rs does, changes nothing where the pixel is covered.
fn depth_bits(t: Triangle, i: i32, j: i32) -> u32 {
    return u32(at_pixel(t.depth, i, j)) & 0xffff0000u;
}

// 8-bit luminance of a covered pixel.
fn luminance(at: u32, i: i32, j: i32) -> u32 {
    let plane = bitcast<vec3<i32>>(input[at + 2u].xyz);
    return u32(at_pixel(plane, i, j) >> 16u) & 0xffu;
}
