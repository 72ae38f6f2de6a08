// Makes a move in the lists: takes out the fragments of the triangles that go and enters those of
// the triangles that come. One invocation owns the pixels of its band. Lists of fewer than four
// are changed in registers; longer ones are put off to a second loop that walks them in memory.

// Four without the fragments that go.
fn without(item: Item, four: Four) -> Four {
    var rest = four;
    var going = goes(item, four.face);
    while any(going) {
        let behind = vec4<bool>(going.x, any(going.xy), any(going.xyz), true);
        let face = vec4<u32>(rest.face.yzw, NO_FACE);
        let fragment = vec4<u32>(rest.fragment.yzw, params.background);
        rest.face = select(rest.face, face, behind);
        rest.fragment = select(rest.fragment, fragment, behind);
        going = select(going, vec4<bool>(going.yzw, false), behind);
    }
    return rest;
}

// Takes out of a list of any length.
fn take_out(item: Item, p: Pixel) {
    var source = 0u;
    var place = 0u;
    var depth = 0u;
    // Close the gaps, front to back.
    while source != NIL && depth < MAX_DEPTH {
        let f = fragment_at(p, source);
        if f.x == NO_FACE {
            break;
        }
        if !goes(item, vec4<u32>(f.x)).x {
            if source != place {
                put(p, place, f);
            }
            place = place_behind(p, place);
        }
        source = place_behind(p, source);
        depth += 1u;
    }
    // Empty what is left behind.
    while place != source && depth > 0u {
        put(p, place, vec2<u32>(NO_FACE, params.background));
        place = place_behind(p, place);
        depth -= 1u;
    }
}

// Last pixel of the item.
fn end_of(item: Item) -> vec2<i32> {
    let cells = vec2<i32>(vec2<u32>(item.n_columns, item.n_rows));
    return min(vec2<i32>(item.x, item.y) + 2 * cells, vec2<i32>(params.size)) - 1;
}

fn take_out_all(item: Item) {
    let end = end_of(item);
    var any_full = false;
    for (var j = item.y; j <= end.y; j += 1) {
        for (var i = item.x; i <= end.x; i += 1) {
            let p = Pixel(vec2<i32>(i, j), item.view);
            let four = load_four(p);
            any_full |= is_full(four);
            if !is_full(four) && any(goes(item, four.face)) {
                store_four(p, without(item, four));
            }
        }
    }
    for (var j = select(end.y + 1, item.y, any_full); j <= end.y; j += 1) {
        for (var i = item.x; i <= end.x; i += 1) {
            let p = Pixel(vec2<i32>(i, j), item.view);
            if is_full(load_four(p)) {
                take_out(item, p);
            }
        }
    }
}

fn enter_triangle(item: Item, at: u32) {
    let t = load_triangle(at);
    let low = max(t.low, vec2<i32>(item.x, item.y));
    let end = min(t.high, end_of(item));
    var any_full = false;
    for (var j = low.y; j <= end.y; j += 1) {
        for (var i = low.x; i <= end.x; i += 1) {
            if shows(t, at, i, j) {
                let p = Pixel(vec2<i32>(i, j), item.view);
                let four = load_four(p);
                any_full |= is_full(four);
                if !is_full(four) {
                    store_four(p, entered(four, t.face, fragment_of(t, at, i, j)));
                }
            }
        }
    }
    for (var j = select(end.y + 1, low.y, any_full); j <= end.y; j += 1) {
        for (var i = low.x; i <= end.x; i += 1) {
            let p = Pixel(vec2<i32>(i, j), item.view);
            let four = load_four(p);
            // Where the loop above filled the list up, the triangle is among the four.
            let is_new = all(four.face != vec4<u32>(t.face));
            if is_full(four) && is_new && shows(t, at, i, j) {
                _ = insert(p, t.face, fragment_of(t, at, i, j));
            }
        }
    }
}

@compute @workgroup_size(64)
fn update(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let place = item_index(id, n_groups);
    if place >> params.lane_bits >= params.n_items {
        return;
    }
    let item = load_item(place);
    if item.n_columns == 0u {
        return;
    }
    take_out_all(item);
    for (var k = 0u; k < item.n_added; k += 1u) {
        enter_triangle(item, item.added_at + 3u * k);
    }
    if was_cut_off() {
        atomicStore(&counters.cut_off, 1u);
    }
}
