// The greatest front depth of a tile. One invocation a tile: item (x, y, x end | y end << 16, view).

@group(0) @binding(0) var near: texture_storage_2d_array<rgba32uint, read>;

@compute @workgroup_size(64)
fn bounds(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let item = item_index(id, n_groups);
    if item >= params.n_items {
        return;
    }
    let tile = word(params.first_item + item);
    var far = 0u;
    for (var y = tile.y; y <= tile.z >> 16u; y += 1u) {
        for (var x = tile.x; x <= (tile.z & 0xffffu); x += 1u) {
            far = max(far, textureLoad(near, vec2<u32>(x, y), tile.w).y >> 16u);
        }
    }
    output[params.output_at + item] = far;
}
