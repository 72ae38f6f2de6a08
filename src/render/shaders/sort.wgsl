// Building, second half: every pixel sorts its stack into its list. One invocation a pixel.

@group(2) @binding(0) var<storage, read_write> tops: array<u32>;
@group(2) @binding(1) var<storage, read_write> nodes: array<vec4<u32>>;

@compute @workgroup_size(64)
fn sort(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let item = item_index(id, n_groups);
    if item >= params.n_items || tops[item] == 0u {
        return;
    }
    let size = u32(params.size);
    let p = Pixel(vec2<i32>(vec2<u32>(item % size, item / size)), params.view);
    let empty = load_four(p);
    var four = empty;
    var depth = 0u;
    var node = tops[item];
    while node != 0u && depth <= MAX_DEPTH {
        let n = nodes[node - 1u];
        four = entered(four, n.x, n.y);
        node = n.z;
        depth += 1u;
    }
    if depth > MAX_DEPTH {
        atomicStore(&counters.too_deep, 1u);
    }
    if depth <= 4u {
        store_four(p, four);
        return;
    }
    // Too long for the four: once more, through the pool.
    node = tops[item];
    while node != 0u && depth <= MAX_DEPTH {
        let n = nodes[node - 1u];
        insert(p, n.x, n.y);
        node = n.z;
    }
}
