// A work item of a move: cells of 2 × 2 pixels of the move's rectangle in one view.

struct Item {
    // First pixel.
    x: i32,
    y: i32,
    // Columns and rows of cells.
    n_columns: u32,
    n_rows: u32,
    view: u32,
    // Triangles that come: place in the input, number.
    added_at: u32,
    n_added: u32,
    // Ids of the triangles that go, four a word, filled up with NIL: place, number of words.
    removed_at: u32,
    n_removed: u32,
}

// What an invocation does: an item, or one cell of it where 64 lanes share an item. A lane beyond
// the item's last cell has no cells.
fn load_item(place: u32) -> Item {
    let index = params.first_item + (place >> params.lane_bits);
    let a = word(2u * index);
    let b = word(2u * index + 1u);
    var item = Item(i32(a.x & 0xffffu), i32(a.x >> 16u), a.y & 0xffffu, a.y >> 16u, a.z,
        b.x, b.y, b.z, b.w);
    if params.lane_bits > 0u {
        let lane = place & ((1u << params.lane_bits) - 1u);
        item.x += 2 * i32(lane % item.n_columns);
        item.y += 2 * i32(lane / item.n_columns);
        item.n_columns = select(0u, 1u, lane < item.n_columns * item.n_rows);
        item.n_rows = 1u;
    }
    return item;
}

fn one_of(face: vec4<u32>, ids: vec4<u32>) -> vec4<bool> {
    return (face == ids.xxxx) | (face == ids.yyyy) | (face == ids.zzzz) | (face == ids.wwww);
}

// Whether the triangles go; any number of ids.
fn goes(item: Item, face: vec4<u32>) -> vec4<bool> {
    var hit = vec4<bool>(false);
    for (var k = 0u; k < item.n_removed; k += 1u) {
        hit = hit | one_of(face, word(item.removed_at + k));
    }
    return hit;
}
