// Copies a view's front fragments, z << 16 | luminance << 8 | reference, to the output.

@group(0) @binding(0) var near: texture_storage_2d_array<rgba32uint, read>;

@compute @workgroup_size(64)
fn fronts(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let item = item_index(id, n_groups);
    if item >= params.n_items {
        return;
    }
    let size = u32(params.size);
    output[item] = textureLoad(near, vec2<u32>(item % size, item / size), params.view).y;
}
