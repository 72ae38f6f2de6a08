// Building, second half: every pixel sorts its stack into its list. One invocation a pixel; dispatched
// again until no stack is left.

@group(2) @binding(0) var<storage, read_write> tops: array<u32>;
@group(2) @binding(1) var<storage, read_write> nodes: array<vec4<u32>>;

// With those of one more insertion and of the eight invocations that share a vector, less than
// 65,535: see was_cut_off.
const STEPS: u32 = 3000u;

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
    var four = load_four(p);
    let is_empty = four.face.x == NO_FACE;
    var depth = 0u;
    var node = tops[item];
    while node != 0u && depth <= 4u {
        let n = nodes[node - 1u];
        four = entered(four, n.x, n.y);
        node = n.z;
        depth += 1u;
    }
    if is_empty && depth <= 4u {
        tops[item] = 0u;
        store_four(p, four);
        return;
    }
    // Too long for the four: through the pool, a part now and the rest in later dispatches.
    node = tops[item];
    var n_steps = 0u;
    while node != 0u && n_steps < STEPS {
        let n = nodes[node - 1u];
        n_steps += 1u + insert(p, n.x, n.y);
        node = n.z;
    }
    tops[item] = node;
    if node != 0u {
        atomicStore(&counters.unsorted, 1u);
    }
    if was_cut_off() {
        atomicStore(&counters.cut_off, 1u);
    }
}
