// The greatest front depth of a tile. One invocation a tile: item (address of the first pixel,
// columns, rows, 0).

@group(0) @binding(1) var<storage, read> depth_lum: array<u32>;

@compute @workgroup_size(64)
fn bounds(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let item = item_index(id, n_groups);
    if item >= params.n_items {
        return;
    }
    let tile = input[params.first_item + item];
    var far = 0u;
    for (var row = 0u; row < tile.z; row += 1u) {
        for (var column = 0u; column < tile.y; column += 1u) {
            far = max(far, depth_lum[tile.x + row * params.row_stride + column] >> 16u);
        }
    }
    output[params.output_at + item] = far;
}
