// A work item of a move: a band of rows of the move's rectangle in one view.

struct Item {
    // Address of the band's first pixel (column a multiple of four).
    first: u32,
    x: i32,
    y: i32,
    // Columns of four pixels, and rows.
    n_quads: u32,
    n_rows: u32,
    // Triangles that come: place in `input`, number.
    added_at: u32,
    n_added: u32,
    // Ids of the triangles that go, four a vector, filled up with NIL: place, number of vectors.
    removed_at: u32,
    n_removed: u32,
}

const KEPT_IDS: u32 = 8u;
// The first ids, kept near: most moves have no more.
var<private> removed: array<vec4<u32>, KEPT_IDS>;

fn load_item(index: u32) -> Item {
    let a = input[2u * index];
    let b = input[2u * index + 1u];
    let item = Item(a.x, i32(a.y & 0xffffu), i32(a.y >> 16u), a.z & 0xffffu, a.z >> 16u,
        b.x, b.y, b.z, b.w);
    for (var k = 0u; k < min(item.n_removed, KEPT_IDS); k += 1u) {
        removed[k] = input[item.removed_at + k];
    }
    return item;
}

fn one_of(face: vec4<u32>, ids: vec4<u32>) -> vec4<bool> {
    return (face == ids.xxxx) | (face == ids.yyyy) | (face == ids.zzzz) | (face == ids.wwww);
}

// Whether the triangles go.
fn goes(item: Item, face: vec4<u32>) -> vec4<bool> {
    var hit = vec4<bool>(false);
    for (var k = 0u; k < min(item.n_removed, KEPT_IDS); k += 1u) {
        hit = hit | one_of(face, removed[k]);
    }
    for (var k = KEPT_IDS; k < item.n_removed; k += 1u) {
        hit = hit | one_of(face, input[item.removed_at + k]);
    }
    return hit;
}
