// The fragment lists, writable, by the one invocation that owns the pixel.
//
// The first four fragments of a pixel lie in two textures, near and deep; the rest are chained
// through the pool. Lists end at the first NO_FACE; pool nodes behind it stay with the pixel for
// later use.

@group(0) @binding(0) var near: texture_storage_2d_array<rgba32uint, read_write>;
@group(0) @binding(1) var deep: texture_storage_2d_array<rgba32uint, read_write>;
// Pool index + 1 of the fifth fragment; 0 when there is none.
@group(0) @binding(2) var heads: texture_storage_2d_array<r32uint, read_write>;
// (face, fragment, index + 1 of the next, 0).
@group(0) @binding(3) var<storage, read_write> pool: array<vec4<u32>>;
@group(0) @binding(4) var<storage, read_write> counters: Counters;

struct Counters {
    pool_used: atomic<u32>,
    nodes_used: atomic<u32>,
    pool_short: atomic<u32>,
    too_deep: atomic<u32>,
    cut_off: atomic<u32>,
    unsorted: atomic<u32>,
}

const MAX_DEPTH: u32 = 4096u;

struct Pixel {
    at: vec2<i32>,
    view: u32,
}

// The first four fragments of a pixel, near to far: triangles, and z << 16 | luminance << 8. Where they lie, the
// first has the reference's luminance in its lowest byte, and the second the pixel's weight.
struct Four {
    face: vec4<u32>,
    fragment: vec4<u32>,
    reference: u32,
    weight: u32,
}

fn load_four(p: Pixel) -> Four {
    let a = textureLoad(near, p.at, p.view);
    let b = textureLoad(deep, p.at, p.view);
    let fragment = vec4<u32>(a.yw & vec2<u32>(0xffffff00u), b.yw);
    return Four(vec4<u32>(a.xz, b.xz), fragment, a.y & 0xffu, a.w & 0xffu);
}

fn store_four(p: Pixel, four: Four) {
    let a = vec4<u32>(four.face.x, four.fragment.x | four.reference, four.face.y,
        four.fragment.y | four.weight);
    let b = vec4<u32>(four.face.z, four.fragment.z, four.face.w, four.fragment.w);
    textureStore(near, p.at, p.view, a);
    textureStore(deep, p.at, p.view, b);
}

fn is_full(four: Four) -> bool {
    return four.face.w != NO_FACE;
}

// Four with a fragment entered at its place; the last is pushed out.
fn entered(four: Four, face: u32, fragment: u32) -> Four {
    let z = four.fragment >> vec4<u32>(16u);
    let new_z = vec4<u32>(fragment >> 16u);
    let behind = (new_z < z) | ((new_z == z) & (vec4<u32>(face) < four.face));
    let first = behind & !vec4<bool>(false, behind.xyz);
    let shifted_face = select(vec4<u32>(0u, four.face.xyz), vec4<u32>(face), first);
    let shifted = select(vec4<u32>(0u, four.fragment.xyz), vec4<u32>(fragment), first);
    return Four(select(four.face, shifted_face, behind), select(four.fragment, shifted, behind),
        four.reference, four.weight);
}

// The place behind `place`, NIL at the end of what the pixel has. Places 0 to 3 are the four, 4 and
// above are the pool's nodes.
fn place_behind(p: Pixel, place: u32) -> u32 {
    if place < 3u {
        return place + 1u;
    }
    var link = 0u;
    if place == 3u {
        link = textureLoad(heads, p.at, p.view).x;
    } else {
        link = pool[place - 4u].z;
    }
    return select(link + 3u, NIL, link == 0u);
}

// (face, fragment) at a place.
fn fragment_at(p: Pixel, place: u32) -> vec2<u32> {
    if place >= 4u {
        return pool[place - 4u].xy;
    }
    let four = load_four(p);
    return vec2<u32>(four.face[place], four.fragment[place]);
}

fn put(p: Pixel, place: u32, f: vec2<u32>) {
    if place >= 4u {
        pool[place - 4u] = vec4<u32>(f, pool[place - 4u].zw);
    } else {
        var four = load_four(p);
        four.face[place] = f.x;
        four.fragment[place] = f.y;
        store_four(p, four);
    }
}

// Gives the pixel one more place behind `last`; NIL when the pool is used up.
fn extend(p: Pixel, last: u32) -> u32 {
    let index = atomicAdd(&counters.pool_used, 1u);
    if index >= params.n_pool {
        atomicStore(&counters.pool_short, 1u);
        return NIL;
    }
    pool[index] = vec4<u32>(NO_FACE, params.background, 0u, 0u);
    if last == 3u {
        textureStore(heads, p.at, p.view, vec4<u32>(index + 1u, 0u, 0u, 0u));
    } else {
        pool[last - 4u].z = index + 1u;
    }
    return index + 4u;
}

// Enters a fragment into a list of any length; how many places it looked at.
fn insert(p: Pixel, face: u32, fragment: u32) -> u32 {
    var carry = vec2<u32>(face, fragment);
    var place = 0u;
    var depth = 0u;
    loop {
        let other = fragment_at(p, place);
        let level = carry.y >> 16u == other.y >> 16u;
        if (carry.y >> 16u < other.y >> 16u) || (level && carry.x < other.x) {
            put(p, place, carry);
            carry = other;
        }
        if carry.x == NO_FACE {
            break;
        }
        var behind = place_behind(p, place);
        if behind == NIL {
            behind = extend(p, place);
        }
        if behind == NIL {
            break;
        }
        place = behind;
        depth += 1u;
        if depth > MAX_DEPTH {
            atomicStore(&counters.too_deep, 1u);
            break;
        }
    }
    return depth;
}
