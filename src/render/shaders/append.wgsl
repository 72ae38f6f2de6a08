// Building, first half: every triangle pushes its fragments on unsorted per-pixel stacks. One
// invocation takes a band of rows of one triangle: item (triangle's place, first row, last row).

@group(2) @binding(0) var<storage, read_write> tops: array<atomic<u32>>;
// (face, fragment, index + 1 of the node below, 0).
@group(2) @binding(1) var<storage, read_write> nodes: array<vec4<u32>>;

fn push(pixel: u32, face: u32, fragment: u32) {
    let node = atomicAdd(&counters.nodes_used, 1u);
    if node < params.n_nodes {
        let below = atomicExchange(&tops[pixel], node + 1u);
        nodes[node] = vec4<u32>(face, fragment, below, 0u);
    }
}

@compute @workgroup_size(64)
fn append(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let item = item_index(id, n_groups);
    if item >= params.n_items {
        return;
    }
    let band = word(params.first_item + item);
    let t = load_triangle(band.x);
    for (var j = i32(band.y); j <= i32(band.z); j += 1) {
        for (var i = t.low.x; i <= t.high.x; i += 1) {
            if shows(t, band.x, i, j) {
                push(u32(j * params.size + i), t.face, fragment_of(t, band.x, i, j));
            }
        }
    }
    if was_cut_off() {
        atomicStore(&counters.cut_off, 1u);
    }
}
