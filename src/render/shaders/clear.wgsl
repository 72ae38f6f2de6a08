// Empties the lists and enters the reference picture. One invocation a pixel; `input` holds the
// reference, four luminances a word.

@compute @workgroup_size(64)
fn clear(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let item = item_index(id, n_groups);
    if item >= params.n_items {
        return;
    }
    let pixel = params.first_pixel + item;
    let reference = (input[item >> 4u][(item >> 2u) & 3u] >> ((item & 3u) * 8u)) & 0xffu;
    for (var layer = 0u; layer < N_LAYERS; layer += 1u) {
        let at = layer * params.n_pixels + pixel;
        faces[at] = NO_FACE;
        depth_lum[at] = params.background | select(0u, reference, layer == 0u);
    }
    links[pixel] = NIL;
}
