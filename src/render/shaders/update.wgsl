// Makes a move in the lists: takes out the fragments of the triangles that go and enters those of
// the triangles that come. One invocation owns the pixels of its band.

fn take_out(item: Item, pixel: u32) {
    var source = pixel;
    var place = pixel;
    var depth = 0u;
    // Close the gaps, front to back.
    while source != NIL && depth < MAX_DEPTH {
        let face = faces[source];
        if face == NO_FACE {
            break;
        }
        if !goes(item, vec4<u32>(face)).x {
            if source != place {
                put(place, face, depth_lum[source] & 0xffffff00u);
            }
            place = address_behind(place);
        }
        source = address_behind(source);
        depth += 1u;
    }
    // Empty what is left behind.
    while place != source && depth > 0u {
        put(place, NO_FACE, params.background);
        place = address_behind(place);
        depth -= 1u;
    }
}

fn enter(item: Item, at: u32) {
    let t = load_triangle(at);
    let low = max(t.low, vec2<i32>(item.x, item.y));
    let end = vec2<i32>(item.x + 4 * i32(item.n_quads), item.y + i32(item.n_rows)) - 1;
    let high = min(t.high, end);
    for (var j = low.y; j <= high.y; j += 1) {
        for (var i = low.x; i <= high.x; i += 1) {
            if covers(t, i, j) {
                let row = item.first + u32(j - item.y) * params.row_stride;
                let fragment = depth_bits(t, i, j) | (luminance(at, i, j) << 8u);
                insert(row + u32(i - item.x), t.face, fragment);
            }
        }
    }
}

@compute @workgroup_size(64)
fn update(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let index = item_index(id, n_groups);
    if index >= params.n_items {
        return;
    }
    let item = load_item(params.first_item + index);
    for (var row = 0u; row < item.n_rows; row += 1u) {
        for (var column = 0u; column < 4u * item.n_quads; column += 1u) {
            take_out(item, item.first + row * params.row_stride + column);
        }
    }
    for (var k = 0u; k < item.n_added; k += 1u) {
        enter(item, item.added_at + 3u * k);
    }
}
