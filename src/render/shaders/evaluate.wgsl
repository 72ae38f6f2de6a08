// The change of energy of one band of one move in one view: raster the triangles that come into a
// small buffer, each within its own rectangle; then compare, cell by cell, the nearest fragment
// that stays with the nearest that comes. Any number of triangles.

const BAND_CELLS: u32 = 64u;
// z << 16 | rank of the nearest triangle that comes, OUTSIDE where there is none.
var<private> nearest: array<vec4<u32>, BAND_CELLS>;

const COLUMN = vec4<i32>(0, 1, 0, 1);
const ROW = vec4<i32>(0, 0, 1, 1);

fn raster(item: Item, rank: u32) {
    let at = item.added_at + 3u * rank;
    let t = load_triangle(at);
    let further = word(at + 2u).w;
    let corner = vec2<i32>(item.x, item.y);
    let last = 2 * vec2<i32>(vec2<u32>(item.n_columns, item.n_rows)) - 1;
    let low = max(t.low - corner, vec2<i32>(0)) >> vec2<u32>(1u);
    let high = min(t.high - corner, last) >> vec2<u32>(1u);
    for (var row = low.y; row <= high.y; row += 1) {
        for (var column = low.x; column <= high.x; column += 1) {
            let i = vec4<i32>(item.x + 2 * column) + COLUMN;
            let j = vec4<i32>(item.y + 2 * row) + ROW;
            let a = t.edge_a.x + t.edge_a.y * i + t.edge_a.z * j;
            let b = t.edge_b.x + t.edge_b.y * i + t.edge_b.z * j;
            let c = t.edge_c.x + t.edge_c.y * i + t.edge_c.z * j;
            let z = bitcast<vec4<u32>>(t.depth.x + t.depth.y * i + t.depth.z * j);
            var key = (z & vec4<u32>(0xffff0000u)) | vec4<u32>(rank)
                | bitcast<vec4<u32>>((a | b | c) >> vec4<u32>(31u));
            if further != 0u {
                for (var k = 0u; k < 4u; k += 1u) {
                    if key[k] != OUTSIDE && is_hole(at, further, i[k], j[k]) {
                        key[k] = OUTSIDE;
                    }
                }
            }
            let slot = u32(row) * item.n_columns + u32(column);
            nearest[slot] = min(nearest[slot], key);
        }
    }
}

// The luminances of the triangles that come.
fn luminances(item: Item, key: vec4<u32>, i: vec4<i32>, j: vec4<i32>) -> vec4<u32> {
    let rank = min(key & vec4<u32>(0xffffu), vec4<u32>(max(item.n_added, 1u) - 1u));
    let at = item.added_at + 3u * rank + 2u;
    let a = bitcast<vec4<i32>>(word(at.x));
    let b = bitcast<vec4<i32>>(word(at.y));
    let c = bitcast<vec4<i32>>(word(at.z));
    let d = bitcast<vec4<i32>>(word(at.w));
    let lum = vec4<i32>(a.x, b.x, c.x, d.x) + vec4<i32>(a.y, b.y, c.y, d.y) * i
        + vec4<i32>(a.z, b.z, c.z, d.z) * j;
    var seen = (bitcast<vec4<u32>>(lum) >> vec4<u32>(16u)) & vec4<u32>(0xffu);
    let further = bitcast<vec4<u32>>(vec4<i32>(a.w, b.w, c.w, d.w));
    if any(further != vec4<u32>(0u)) {
        for (var k = 0u; k < 4u; k += 1u) {
            seen[k] = painted(at[k] - 2u, further[k], seen[k], i[k], j[k]);
        }
    }
    return seen;
}

@compute @workgroup_size(64)
fn evaluate(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let place = item_index(id, n_groups);
    let item = item_to_judge(place);
    if item.n_columns == 0u {
        return;
    }
    let n_cells = item.n_columns * item.n_rows;
    for (var slot = 0u; slot < n_cells; slot += 1u) {
        nearest[slot] = vec4<u32>(OUTSIDE);
    }
    for (var rank = 0u; rank < item.n_added; rank += 1u) {
        raster(item, rank);
    }
    var sum = vec4<i32>(0);
    var put_off = vec2<u32>(0u);
    var corner = vec2<i32>(0);
    for (var cell = 0u; cell < n_cells; cell += 1u) {
        let i = vec4<i32>(item.x + corner.x) + COLUMN;
        let j = vec4<i32>(item.y + corner.y) + ROW;
        let a = textureLoad(near, vec2<i32>(i.x, j.x), item.view);
        let b = textureLoad(near, vec2<i32>(i.y, j.y), item.view);
        let c = textureLoad(near, vec2<i32>(i.z, j.z), item.view);
        let d = textureLoad(near, vec2<i32>(i.w, j.w), item.view);
        let front = vec4<u32>(a.y, b.y, c.y, d.y);
        let going = goes(item, vec4<u32>(a.x, b.x, c.x, d.x));
        let unsure = going & goes(item, vec4<u32>(a.z, b.z, c.z, d.z));
        let stays = select(front, vec4<u32>(a.w, b.w, c.w, d.w), going);
        let key = nearest[cell];
        let z_comes = key >> vec4<u32>(16u);
        let z_stays = stays >> vec4<u32>(16u);
        let level = (z_comes == z_stays) & (key != vec4<u32>(OUTSIDE));
        let low = vec4<u32>(0xffu);
        let lum = select(stays >> vec4<u32>(8u), luminances(item, key, i, j), z_comes < z_stays);
        let reference = front & low;
        let weight = bitcast<vec4<i32>>(vec4<u32>(a.w, b.w, c.w, d.w) & low);
        let change = weight * (square((lum & low) - reference)
            - square(((front >> vec4<u32>(8u)) & low) - reference));
        let shown = (i < vec4<i32>(params.size)) & (j < vec4<i32>(params.size));
        let later = any((unsure | level) & shown);
        let bit = select(0u, 1u << (cell & 31u), later);
        put_off |= select(vec2<u32>(bit, 0u), vec2<u32>(0u, bit), cell > 31u);
        sum += select(vec4<i32>(0), change, shown & vec4<bool>(!later));
        corner.x += 2;
        if corner.x == 2 * i32(item.n_columns) {
            corner = vec2<i32>(0, corner.y + 2);
        }
    }
    let all = sum.x + sum.y + sum.z + sum.w + change_of_rest(item, put_off);
    output[params.output_at + place] = select(bitcast<u32>(all), CUT_OFF, was_cut_off());
}
