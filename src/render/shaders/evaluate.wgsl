// The change of energy of one band of one move in one view: raster the triangles that come into a
// small buffer, each within its own rectangle; then compare, four pixels at a time, the nearest
// fragment that stays with the nearest that comes. Any number of triangles.

@group(0) @binding(0) var<storage, read> faces: array<vec4<u32>>;
@group(0) @binding(1) var<storage, read> depth_lum: array<vec4<u32>>;
@group(0) @binding(2) var<storage, read> links: array<u32>;

const BAND_QUADS: u32 = 64u;
// z << 16 | rank of the nearest triangle that comes, OUTSIDE where there is none.
var<private> nearest: array<vec4<u32>, BAND_QUADS>;

fn raster(item: Item, rank: u32) {
    let t = load_triangle(item.added_at + 3u * rank);
    let low = max(t.low, vec2<i32>(item.x, item.y)) - vec2<i32>(item.x, item.y);
    let end = vec2<i32>(item.x + 4 * i32(item.n_quads), item.y + i32(item.n_rows)) - 1;
    let high = min(t.high, end) - vec2<i32>(item.x, item.y);
    for (var row = low.y; row <= high.y; row += 1) {
        for (var quad = low.x >> 2u; quad <= high.x >> 2u; quad += 1) {
            let i = vec4<i32>(item.x + 4 * quad) + vec4<i32>(0, 1, 2, 3);
            let j = item.y + row;
            let a = t.edge_a.x + t.edge_a.y * i + t.edge_a.z * j;
            let b = t.edge_b.x + t.edge_b.y * i + t.edge_b.z * j;
            let c = t.edge_c.x + t.edge_c.y * i + t.edge_c.z * j;
            let z = bitcast<vec4<u32>>(t.depth.x + t.depth.y * i + t.depth.z * j);
            let key = (z & vec4<u32>(0xffff0000u)) | vec4<u32>(rank)
                | bitcast<vec4<u32>>((a | b | c) >> vec4<u32>(31u));
            let slot = u32(row) * item.n_quads + u32(quad);
            nearest[slot] = min(nearest[slot], key);
        }
    }
}

// The fragment of pool address `at` or behind it that stays, as (face, z << 16 | luminance << 8).
fn stays_in_pool(item: Item, pixel: u32) -> vec2<u32> {
    let chained = (N_LAYERS - 1u) * params.n_pixels;
    var at = links[pixel];
    while at != NIL {
        let face = faces[at >> 2u][at & 3u];
        if !goes(item, vec4<u32>(face)).x {
            return vec2<u32>(face, depth_lum[at >> 2u][at & 3u]);
        }
        at = links[at - chained];
    }
    return vec2<u32>(NO_FACE, params.background);
}

fn square(v: vec4<u32>) -> vec4<i32> {
    return bitcast<vec4<i32>>(v * v);
}

// The change of four pixels.
fn resolve(item: Item, row: u32, quad: u32) -> i32 {
    let first = item.first + row * params.row_stride + 4u * quad;
    let front_face = faces[first >> 2u];
    let front = depth_lum[first >> 2u];
    var face = front_face;
    var stay = front;
    var looking = goes(item, front_face);
    for (var layer = 1u; layer < N_LAYERS && any(looking); layer += 1u) {
        let at = (layer * params.n_pixels + first) >> 2u;
        face = select(face, faces[at], looking);
        stay = select(stay, depth_lum[at], looking);
        looking = looking & goes(item, face);
    }
    if any(looking) {
        for (var k = 0u; k < 4u; k += 1u) {
            if looking[k] {
                let f = stays_in_pool(item, first + k);
                face[k] = f.x;
                stay[k] = f.y;
            }
        }
    }
    let key = nearest[row * item.n_quads + quad];
    let i = vec4<i32>(item.x + 4 * i32(quad)) + vec4<i32>(0, 1, 2, 3);
    var lum = (stay >> vec4<u32>(8u)) & vec4<u32>(0xffu);
    for (var k = 0u; k < 4u; k += 1u) {
        let comes = key[k] >> 16u;
        let stays = stay[k] >> 16u;
        let level = comes == stays;
        if key[k] != OUTSIDE && comes <= stays {
            let added = item.added_at + 3u * (key[k] & 0xffffu);
            if !level || input[added + 1u].w < face[k] {
                lum[k] = luminance(added, i[k], item.y + i32(row));
            }
        }
    }
    let reference = front & vec4<u32>(0xffu);
    let before = (front >> vec4<u32>(8u)) & vec4<u32>(0xffu);
    let change = square(lum - reference) - square(before - reference);
    let shown = select(vec4<i32>(0), change, i < vec4<i32>(params.size));
    return shown.x + shown.y + shown.z + shown.w;
}

@compute @workgroup_size(64)
fn evaluate(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let index = item_index(id, n_groups);
    if index >= params.n_items {
        return;
    }
    let item = load_item(params.first_item + index);
    for (var slot = 0u; slot < item.n_quads * item.n_rows; slot += 1u) {
        nearest[slot] = vec4<u32>(OUTSIDE);
    }
    for (var rank = 0u; rank < item.n_added; rank += 1u) {
        raster(item, rank);
    }
    var sum = 0;
    for (var row = 0u; row < item.n_rows; row += 1u) {
        for (var quad = 0u; quad < item.n_quads; quad += 1u) {
            sum += resolve(item, row, quad);
        }
    }
    output[params.output_at + index] = bitcast<u32>(sum);
}
