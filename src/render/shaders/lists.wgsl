// The fragment lists, writable: insertion and removal by the one invocation that owns the pixel.

@group(0) @binding(0) var<storage, read_write> faces: array<u32>;
// z << 16 | luminance << 8; the front layer also holds the reference luminance in its low byte.
@group(0) @binding(1) var<storage, read_write> depth_lum: array<u32>;
@group(0) @binding(2) var<storage, read_write> links: array<u32>;
@group(0) @binding(3) var<storage, read_write> counters: Counters;

struct Counters {
    pool_used: atomic<u32>,
    nodes_used: atomic<u32>,
    pool_short: atomic<u32>,
    too_deep: atomic<u32>,
}

// The address behind `at`; NIL at the end of the pixel's storage.
fn address_behind(at: u32) -> u32 {
    let chained = (N_LAYERS - 1u) * params.n_pixels;
    if at < chained {
        return at + params.n_pixels;
    }
    return links[at - chained];
}

// Gives the pixel one more place behind `last`; NIL when the pool is used up.
fn extend(last: u32) -> u32 {
    let chained = (N_LAYERS - 1u) * params.n_pixels;
    let at = N_LAYERS * params.n_pixels + atomicAdd(&counters.pool_used, 1u);
    if at >= params.n_addresses {
        atomicStore(&counters.pool_short, 1u);
        return NIL;
    }
    links[last - chained] = at;
    links[at - chained] = NIL;
    faces[at] = NO_FACE;
    depth_lum[at] = params.background;
    return at;
}

fn put(at: u32, face: u32, fragment: u32) {
    faces[at] = face;
    depth_lum[at] = fragment | (depth_lum[at] & 0xffu);
}

// Enters a fragment at its place and moves the rest back by one.
fn insert(pixel: u32, new_face: u32, new_fragment: u32) {
    var face = new_face;
    var fragment = new_fragment;
    var at = pixel;
    var depth = 0u;
    loop {
        let other_face = faces[at];
        let other = depth_lum[at] & 0xffffff00u;
        let nearer = fragment >> 16u < other >> 16u;
        let level = fragment >> 16u == other >> 16u;
        if nearer || (level && face < other_face) {
            put(at, face, fragment);
            face = other_face;
            fragment = other;
        }
        if face == NO_FACE {
            break;
        }
        var behind = address_behind(at);
        if behind == NIL {
            behind = extend(at);
        }
        if behind == NIL {
            break;
        }
        at = behind;
        depth += 1u;
        if depth > MAX_DEPTH {
            atomicStore(&counters.too_deep, 1u);
            break;
        }
    }
}
