// Building, second half: every pixel sorts its stack into its list. One invocation a pixel.

@group(2) @binding(0) var<storage, read_write> heads: array<u32>;
@group(2) @binding(1) var<storage, read_write> nodes: array<vec4<u32>>;

@compute @workgroup_size(64)
fn sort(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let item = item_index(id, n_groups);
    if item >= params.n_items {
        return;
    }
    var node = heads[item];
    var depth = 0u;
    while node != 0u {
        let n = nodes[node - 1u];
        insert(params.first_pixel + item, n.x, n.y);
        node = n.z;
        depth += 1u;
        if depth > MAX_DEPTH {
            atomicStore(&counters.too_deep, 1u);
            break;
        }
    }
}
