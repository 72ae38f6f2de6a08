// Empties a view's lists and enters its reference picture. One invocation a pixel; the input holds
// the reference, sixteen luminances a word, and behind it the weights in the same way.

@compute @workgroup_size(64)
fn clear(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) n_groups: vec3<u32>,
) {
    let item = item_index(id, n_groups);
    if item >= params.n_items {
        return;
    }
    let size = u32(params.size);
    let p = Pixel(vec2<i32>(vec2<u32>(item % size, item / size)), params.view);
    let at = vec2<u32>(item >> 4u, (params.n_items >> 4u) + (item >> 4u));
    let shift = (item & 3u) * 8u;
    let reference = (word(at.x)[(item >> 2u) & 3u] >> shift) & 0xffu;
    let weight = (word(at.y)[(item >> 2u) & 3u] >> shift) & 0xffu;
    store_four(p, Four(vec4<u32>(NO_FACE), vec4<u32>(params.background), reference, weight));
    textureStore(heads, p.at, p.view, vec4<u32>(0u));
}
