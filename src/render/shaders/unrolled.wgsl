// As evaluate.wgsl, for moves of few triangles under flat shading: every triangle is held in
// registers and tried on every cell.
//
// A template: a line that names {k} is repeated for each of the triangles that come, a line that
// names {m} for each of the words of ids that go.

// A triangle ready for stepping: edge functions and depth as (at_origin, dx, dy), and its rank << 8
// | luminance.
struct Ready {
    a: vec3<i32>,
    b: vec3<i32>,
    c: vec3<i32>,
    z: vec3<i32>,
    tag: u32,
}

fn ready(item: Item, rank: u32) -> Ready {
    let at = item.added_at + 3u * min(rank, item.n_added);
    let corners = word(at);
    let plane = word(at + 1u);
    let a = corner(corners.x);
    let b = corner(corners.y);
    let c = corner(corners.z);
    var t = Ready(edge(a, b), edge(b, c), edge(c, a), bitcast<vec3<i32>>(plane.xyz),
        rank << 8u | corners.w);
    // A triangle that is not there covers nothing.
    let nothing = vec3<bool>(rank >= item.n_added);
    t.a = select(t.a, vec3<i32>(-1, 0, 0), nothing);
    t.b = select(t.b, vec3<i32>(-1, 0, 0), nothing);
    t.c = select(t.c, vec3<i32>(-1, 0, 0), nothing);
    return t;
}

// A plane on the four pixels of the cell at (i, j).
fn on_cell(plane: vec3<i32>, i: i32, j: i32) -> vec4<i32> {
    let first = plane.x + plane.y * i + plane.z * j;
    let below = first + plane.z;
    return vec4<i32>(first, first + plane.y, below, below + plane.y);
}

// z << 16 | rank << 8 | luminance where the triangle covers, OUTSIDE elsewhere.
fn keys(t: Ready, i: i32, j: i32) -> vec4<u32> {
    let inside = on_cell(t.a, i, j) | on_cell(t.b, i, j) | on_cell(t.c, i, j);
    let outside = bitcast<vec4<u32>>(inside >> vec4<u32>(31u));
    let z = bitcast<vec4<u32>>(on_cell(t.z, i, j));
    return (z & vec4<u32>(0xffff0000u)) | vec4<u32>(t.tag) | outside;
}

fn ids(item: Item, k: u32) -> vec4<u32> {
    return select(vec4<u32>(NIL), word(item.removed_at + k), vec4<bool>(k < item.n_removed));
}

struct Going {
    g{m}: vec4<u32>,
}

fn goes_fast(going: Going, face: vec4<u32>) -> vec4<bool> {
    var hit = vec4<bool>(false);
    hit = hit | one_of(face, going.g{m});
    return hit;
}

struct Move {
    t{k}: Ready,
    going: Going,
}

struct Cell {
    change: vec4<i32>,
    unsure: bool,
}

// The change of the cell at (i, j). `look_deep`: looks at four fragments of each pixel, else at two. It
// is unsure where all those go, and where depths are level.
fn cell(mv: Move, item: Item, i: i32, j: i32, look_deep: bool) -> Cell {
    var key = vec4<u32>(OUTSIDE);
    key = min(key, keys(mv.t{k}, i, j));
    let at = array<vec2<i32>, 4>(vec2<i32>(i, j), vec2<i32>(i + 1, j), vec2<i32>(i, j + 1),
        vec2<i32>(i + 1, j + 1));
    let a = textureLoad(near, at[0], item.view);
    let b = textureLoad(near, at[1], item.view);
    let c = textureLoad(near, at[2], item.view);
    let d = textureLoad(near, at[3], item.view);
    let front = vec4<u32>(a.y, b.y, c.y, d.y);
    let first = goes_fast(mv.going, vec4<u32>(a.x, b.x, c.x, d.x));
    let second = first & goes_fast(mv.going, vec4<u32>(a.z, b.z, c.z, d.z));
    var stays = select(front, vec4<u32>(a.w, b.w, c.w, d.w), first);
    var unsure = second;
    if look_deep {
        let e = textureLoad(deep, at[0], item.view);
        let f = textureLoad(deep, at[1], item.view);
        let g = textureLoad(deep, at[2], item.view);
        let h = textureLoad(deep, at[3], item.view);
        let third = second & goes_fast(mv.going, vec4<u32>(e.x, f.x, g.x, h.x));
        unsure = third & goes_fast(mv.going, vec4<u32>(e.z, f.z, g.z, h.z));
        stays = select(stays, vec4<u32>(e.y, f.y, g.y, h.y), second);
        stays = select(stays, vec4<u32>(e.w, f.w, g.w, h.w), third);
    }
    let z_comes = key >> vec4<u32>(16u);
    let z_stays = stays >> vec4<u32>(16u);
    let level = (z_comes == z_stays) & (key != vec4<u32>(OUTSIDE));
    let low = vec4<u32>(0xffu);
    let lum = select(stays >> vec4<u32>(8u), key, z_comes < z_stays) & low;
    let reference = front & low;
    let weight = bitcast<vec4<i32>>(vec4<u32>(a.w, b.w, c.w, d.w) & low);
    let change = weight
        * (square(lum - reference) - square(((front >> vec4<u32>(8u)) & low) - reference));
    let in_x = vec2<bool>(i < params.size, i + 1 < params.size);
    let shown = in_x.xyxy & (vec4<i32>(j, j, j + 1, j + 1) < vec4<i32>(params.size));
    let is_unsure = any((unsure | level) & shown);
    return Cell(select(vec4<i32>(0), change, shown & vec4<bool>(!is_unsure)), is_unsure);
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
    var mv: Move;
    mv.going.g{m} = ids(item, {m}u);
    mv.t{k} = ready(item, {k}u);
    let n_cells = item.n_columns * item.n_rows;
    let end = item.x + 2 * i32(item.n_columns);
    var sum = vec4<i32>(0);
    var put_off = vec2<u32>(0u);
    var i = item.x;
    var j = item.y;
    for (var k = 0u; k < n_cells; k += 1u) {
        let c = cell(mv, item, i, j, false);
        sum += c.change;
        let bit = select(0u, 1u << (k & 31u), c.unsure);
        put_off |= select(vec2<u32>(bit, 0u), vec2<u32>(0u, bit), k > 31u);
        i += 2;
        if i == end {
            i = item.x;
            j += 2;
        }
    }
    var rest = vec2<u32>(0u);
    while any(put_off != vec2<u32>(0u)) {
        let k = first_bit(put_off);
        put_off = without_first_bit(put_off);
        let corner = 2 * vec2<i32>(vec2<u32>(k % item.n_columns, k / item.n_columns));
        let c = cell(mv, item, item.x + corner.x, item.y + corner.y, true);
        sum += c.change;
        let bit = select(0u, 1u << (k & 31u), c.unsure);
        rest |= select(vec2<u32>(bit, 0u), vec2<u32>(0u, bit), k > 31u);
    }
    let all = sum.x + sum.y + sum.z + sum.w + change_of_rest(item, rest);
    output[params.output_at + place] = select(bitcast<u32>(all), CUT_OFF, was_cut_off());
}
