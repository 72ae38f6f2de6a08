// What every kernel shares: parameters, input and output, and the packed triangle.
//
// Integers only. All floating point was done on the host; arithmetic is modulo 2^32 as in
// lattice.rs, so every adapter gives the same bits.
//
// What is read often lies in storage textures: lavapipe reads them twenty times faster than
// storage buffers (15 against 295 ns for eight lanes), and graphics processors cache both.

const NIL: u32 = 0xffffffffu;
// The background's id, above every triangle's.
const NO_FACE: u32 = 0xfffffffeu;
const OUTSIDE: u32 = 0xffffffffu;
const WORKGROUP: u32 = 64u;
// The result of an item whose loops were cut off; no sum of 256 squares, each up to 16 times, is so low.
const CUT_OFF: u32 = 0x80000000u;
// log2 of the input's width in words.
const INPUT_WIDTH_BITS: u32 = 10u;
// log2 of the texels' width.
const TEXELS_WIDTH_BITS: u32 = 12u;
// Whether a texture gives something off: where none does, nobody looks.
override GLOWS: bool = false;

struct Params {
    first_item: u32,
    n_items: u32,
    output_at: u32,
    size: i32,
    first_center: i32,
    sub_bits: u32,
    background: u32,
    view: u32,
    n_nodes: u32,
    n_pool: u32,
    lane_bits: u32,
}
var<immediate> params: Params;

@group(1) @binding(0) var input: texture_storage_2d<rgba32uint, read>;
@group(1) @binding(1) var<storage, read_write> output: array<u32>;
@group(1) @binding(2) var texels: texture_storage_2d<r32uint, read>;

// A word (four numbers) of the input.
fn word(at: u32) -> vec4<u32> {
    let column = at & ((1u << INPUT_WIDTH_BITS) - 1u);
    return textureLoad(input, vec2<u32>(column, at >> INPUT_WIDTH_BITS));
}

// The item of this invocation; n_items or more when there is none.
fn item_index(id: vec3<u32>, n_groups: vec3<u32>) -> u32 {
    return id.x + id.y * n_groups.x * WORKGROUP;
}

// Whether the driver ended loops of this invocation early: lavapipe grants all the loops of an
// invocation (and of those that share its vector) 65,535 rounds together, and then says nothing but
// ends each after one. So a last loop tells; the compiler must not know how many rounds it takes.
fn was_cut_off() -> bool {
    let n_wanted = 3u + (params.n_pool >> 31u);
    var n_made = 0u;
    for (var k = 0u; k < n_wanted; k += 1u) {
        n_made += 1u;
    }
    return n_made != n_wanted;
}

// A triangle: edge functions and planes as (at_origin, dx, dy), and the pixels it may cover.
struct Triangle {
    edge_a: vec3<i32>,
    edge_b: vec3<i32>,
    edge_c: vec3<i32>,
    depth: vec3<i32>,
    low: vec2<i32>,
    high: vec2<i32>,
    face: u32,
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
    let corners = word(at);
    let plane = word(at + 1u);
    let a = corner(corners.x);
    let b = corner(corners.y);
    let c = corner(corners.z);
    let up = (1 << params.sub_bits) - 1;
    let center = vec2<i32>(params.first_center);
    let shift = vec2<u32>(params.sub_bits);
    let low = (min(min(a, b), c) - center + up) >> shift;
    let high = (max(max(a, b), c) - center) >> shift;
    return Triangle(edge(a, b), edge(b, c), edge(c, a), bitcast<vec3<i32>>(plane.xyz),
        max(low, vec2<i32>(0)), min(high, vec2<i32>(params.size - 1)), plane.w);
}

fn at_pixel(plane: vec3<i32>, i: i32, j: i32) -> i32 {
    return plane.x + plane.y * i + plane.z * j;
}

fn covers(t: Triangle, i: i32, j: i32) -> bool {
    return (at_pixel(t.edge_a, i, j) | at_pixel(t.edge_b, i, j) | at_pixel(t.edge_c, i, j)) >= 0;
}

// A luminance at a pixel of the triangle at `at`, seen through the texture that is described `further` words
// on (0: it has none), with what it gives off. See paint.rs.
fn painted(at: u32, further: u32, lum: u32, i: i32, j: i32) -> u32 {
    if further == 0u {
        return lum;
    }
    let place = place_on(at, further, i, j);
    let seen = (lum * look_up(word(at + further).w, place) * 257u + 32768u) >> 16u;
    if !GLOWS {
        return seen;
    }
    let glow_at = word(at + further + 2u).w;
    if glow_at == 0u {
        return seen;
    }
    return min(seen + look_up(glow_at, place), 255u);
}

// Whether the texture has a hole there.
fn is_hole(at: u32, further: u32, i: i32, j: i32) -> bool {
    if further == 0u {
        return false;
    }
    let holes = word(at + further + 5u).zw;
    if holes.x == 0u {
        return false;
    }
    let least = select(holes.y, dither(u32(i), u32(j)), holes.y == 0u);
    return look_up(holes.x, place_on(at, further, i, j)) < least;
}

fn dither(i: u32, j: u32) -> u32 {
    let x = i ^ j;
    let rank = (x & 1u) << 5u | (j & 1u) << 4u | (x & 2u) << 2u | (j & 2u) << 1u | (x & 4u) >> 1u | (j & 4u) >> 2u;
    return 4u * rank + 2u;
}

// Whether the triangle at `at`, holes left out, covers a pixel.
fn shows(t: Triangle, at: u32, i: i32, j: i32) -> bool {
    if !covers(t, i, j) {
        return false;
    }
    return !is_hole(at, word(at + 2u).w, i, j);
}

// Where a pixel lies on a texture: in 64ths of a texel of its level, of which log2 of width and height.
struct Place {
    at: vec2<i32>,
    bits: vec2<u32>,
}

fn place_on(at: u32, further: u32, i: i32, j: i32) -> Place {
    let near_plane = word(at + further);
    let one_plane = word(at + further + 1u);
    let near = u32(at_pixel(bitcast<vec3<i32>>(near_plane.xyz), i, j) >> 16u);
    let one = u32(at_pixel(bitcast<vec3<i32>>(one_plane.xyz), i, j) >> 16u);
    let two = u32(at_pixel(bitcast<vec3<i32>>(word(at + further + 2u).xyz), i, j) >> 16u);
    let per_near = (1u << 29u) / max(near, 1u);
    let share_one = vec2<i32>(i32((one * per_near) >> 14u));
    let share_two = vec2<i32>(i32((two * per_near) >> 14u));
    let ends = bitcast<vec4<i32>>(word(at + further + 3u));
    let rest = bitcast<vec4<i32>>(word(at + further + 4u));
    let high = bitcast<vec4<i32>>(word(at + further + 5u));
    let by = share_one * ends.zw + share_two * rest.xy;
    let place = clamp(ends.xy + ((by + (1 << 14u)) >> vec2<u32>(15u)), rest.zw, high.xy);
    return Place(place, vec2<u32>(one_plane.w & 0xffu, one_plane.w >> 8u));
}

// What the level that begins at a word holds there.
fn look_up(first: u32, place: Place) -> u32 {
    let whole = vec2<u32>(place.at >> vec2<u32>(6u)) & ((vec2<u32>(1u) << place.bits) - 1u);
    let texel = first + (whole.y << place.bits.x) + whole.x;
    let column = texel & ((1u << TEXELS_WIDTH_BITS) - 1u);
    let four = textureLoad(texels, vec2<u32>(column, texel >> TEXELS_WIDTH_BITS)).x;
    let share = vec2<u32>(place.at & vec2<i32>(63));
    let left = vec2<u32>(four & 0xffu, (four >> 16u) & 0xffu);
    let right = vec2<u32>((four >> 8u) & 0xffu, four >> 24u);
    let across = left * (64u - share.x) + right * share.x;
    return (across.x * (64u - share.y) + across.y * share.y + 2048u) >> 12u;
}

// z << 16 | luminance << 8 of a covered pixel. The host scaled both planes to 16 fraction bits;
// clamping to the corners' range, as lattice.rs does, changes nothing where the pixel is covered.
fn fragment_of(t: Triangle, at: u32, i: i32, j: i32) -> u32 {
    let plane = word(at + 2u);
    let lum = (u32(at_pixel(bitcast<vec3<i32>>(plane.xyz), i, j)) >> 16u) & 0xffu;
    let seen = painted(at, plane.w, lum, i, j);
    return (u32(at_pixel(t.depth, i, j)) & 0xffff0000u) | (seen << 8u);
}
