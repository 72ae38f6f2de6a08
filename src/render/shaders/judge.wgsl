// The lists, read only, and the change of one pixel in full generality: slow and simple. The fast
// kernels leave to it the pixels where they cannot be sure.

@group(0) @binding(0) var near: texture_storage_2d_array<rgba32uint, read>;
@group(0) @binding(1) var deep: texture_storage_2d_array<rgba32uint, read>;
@group(0) @binding(2) var heads: texture_storage_2d_array<r32uint, read>;
@group(0) @binding(3) var<storage, read> pool: array<vec4<u32>>;

fn square(v: vec4<u32>) -> vec4<i32> {
    return bitcast<vec4<i32>>(v * v);
}

// The nearest fragment of a pixel that stays: (face, fragment).
fn nearest_that_stays(item: Item, at: vec2<i32>) -> vec2<u32> {
    let a = textureLoad(near, at, item.view);
    let b = textureLoad(deep, at, item.view);
    let face = vec4<u32>(a.xz, b.xz);
    let fragment = vec4<u32>(a.yw, b.yw);
    let going = goes(item, face);
    for (var k = 0u; k < 4u; k += 1u) {
        if !going[k] {
            return vec2<u32>(face[k], fragment[k]);
        }
    }
    var link = textureLoad(heads, at, item.view).x;
    while link != 0u {
        let node = pool[link - 1u];
        if !goes(item, vec4<u32>(node.x)).x {
            return node.xy;
        }
        link = node.z;
    }
    return vec2<u32>(NO_FACE, params.background);
}

// The nearest fragment of a pixel that comes.
fn nearest_that_comes(item: Item, at: vec2<i32>) -> vec2<u32> {
    var best = vec2<u32>(NO_FACE, 0xffff0000u);
    for (var k = 0u; k < item.n_added; k += 1u) {
        let place = item.added_at + 3u * k;
        let t = load_triangle(place);
        let fragment = fragment_of(t, place, at.x, at.y);
        // Triangles come by ascending id, so the first of equals is the nearest.
        let nearer = fragment >> 16u < best.y >> 16u || best.x == NO_FACE;
        if nearer && shows(t, place, at.x, at.y) {
            best = vec2<u32>(t.face, fragment);
        }
    }
    return best;
}

fn change_at(item: Item, at: vec2<i32>) -> i32 {
    if at.x >= params.size || at.y >= params.size {
        return 0;
    }
    let first = textureLoad(near, at, item.view);
    let front = first.y;
    let stays = nearest_that_stays(item, at);
    let comes = nearest_that_comes(item, at);
    let level = comes.y >> 16u == stays.y >> 16u;
    let wins = comes.y >> 16u < stays.y >> 16u || (level && comes.x < stays.x);
    let shown = select(stays.y, comes.y, wins);
    let lum = (vec4<u32>(shown, front, 0u, 0u) >> vec4<u32>(8u)) & vec4<u32>(0xffu);
    let squares = square(lum - vec4<u32>(front & 0xffu));
    return i32(first.w & 0xffu) * (squares.x - squares.y);
}

// A set of at most 64 cells, a bit each.
fn first_bit(cells: vec2<u32>) -> u32 {
    let high = cells.x == 0u;
    return firstTrailingBit(select(cells.x, cells.y, high)) + select(0u, 32u, high);
}

fn without_first_bit(cells: vec2<u32>) -> vec2<u32> {
    if cells.x == 0u {
        return vec2<u32>(0u, cells.y & (cells.y - 1u));
    }
    return vec2<u32>(cells.x & (cells.x - 1u), cells.y);
}

// The change of a set of cells.
fn change_of_rest(item: Item, cells: vec2<u32>) -> i32 {
    var rest = cells;
    var sum = 0;
    while any(rest != vec2<u32>(0u)) {
        let cell = first_bit(rest);
        rest = without_first_bit(rest);
        let corner = vec2<i32>(vec2<u32>(cell % item.n_columns, cell / item.n_columns) * 2u);
        for (var k = 0; k < 4; k += 1) {
            sum += change_at(item, vec2<i32>(item.x, item.y) + corner + vec2<i32>(k & 1, k >> 1u));
        }
    }
    return sum;
}

// What an invocation judges: no cells where there is no item, or where a lane is left over, which adds nothing.
fn item_to_judge(place: u32) -> Item {
    var item: Item;
    if place >> params.lane_bits < params.n_items {
        item = load_item(place);
        if item.n_columns == 0u {
            output[params.output_at + place] = 0u;
        }
    }
    return item;
}
