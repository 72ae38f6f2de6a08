//! [`super::kernel`], eight pixels at a time: one block of 4 × 2 (see [`super::fragments`]).

use std::arch::x86_64::{
    __m256i, _mm_cvtsi64_si128, _mm256_add_epi32, _mm256_and_si256, _mm256_andnot_si256,
    _mm256_blendv_epi8, _mm256_castsi256_ps, _mm256_cmpeq_epi32, _mm256_cmpgt_epi32,
    _mm256_cvtepu8_epi32, _mm256_cvtepu16_epi32, _mm256_max_epi32, _mm256_min_epi32,
    _mm256_min_epu32, _mm256_movemask_ps, _mm256_mullo_epi32, _mm256_or_si256, _mm256_set1_epi32,
    _mm256_setr_epi32, _mm256_setzero_si256, _mm256_slli_epi32, _mm256_srai_epi32,
    _mm256_srli_epi32, _mm256_sub_epi32, _mm256_testz_si256,
};

use super::{
    fragments::{BLOCK_HEIGHT, BLOCK_WIDTH, Block, LANES},
    kernel::{BlockRect, Judged, NOTHING, Scratch, pixel_delta},
    kernel_avx2_paint::Brush,
    lattice::{DEPTH_BITS, LUM_BITS, Plane, Setup},
};

/// Eight 32-bit integers, one a pixel; masks are 0 or -1.
pub(super) type Lanes = __m256i;

/// The change of energy of a move in one view.
#[target_feature(enable = "avx2")]
pub fn delta(of: &Judged<'_>, scratch: &mut Scratch) -> i64 {
    let blocks = BlockRect::of(&of.rect);
    let width = blocks.width();
    scratch.keys.clear();
    scratch.keys.resize(width * blocks.height(), [NOTHING; LANES]);
    for (rank, (_, setup)) in of.setups.iter().enumerate() {
        raster(setup, rank, blocks, of.texels, &mut scratch.keys);
    }
    scratch.removed.clear();
    scratch.removed.extend(of.removed.iter().map(|id| [*id; LANES]));
    let (mut sum, mut first) = (0, of.lists.block_index(blocks.x0, blocks.y0));
    for coming in scratch.keys.chunks_exact(width) {
        sum += if of.lists.is_weighed() {
            resolve_row::<true>(of, &scratch.removed, first, coming)
        } else {
            resolve_row::<false>(of, &scratch.removed, first, coming)
        };
        first += of.lists.blocks_per_row() as usize;
    }
    sum
}

/// Enters the fragments of an added triangle where they are the nearest.
#[target_feature(enable = "avx2")]
fn raster(s: &Setup, rank: usize, blocks: BlockRect, texels: &[u32], keys: &mut [[u32; LANES]]) {
    let own = BlockRect::of(&s.rect);
    let (i0, j0) = (own.x0 * BLOCK_WIDTH, own.y0 * BLOCK_HEIGHT);
    let mut edges = s.edges.map(|e| Affine::new([e.at_origin, e.dx, e.dy], i0, j0));
    let mut depth = Affine::of_plane(&s.depth, i0, j0);
    let is_flat = s.lum.min == s.lum.max;
    let mut lum = if is_flat { depth } else { Affine::of_plane(&s.lum, i0, j0) };
    let mut brush = s.paint.as_ref().map(|paint| Brush::new(paint, texels, i0, j0));
    let low = (rank << 8) as i32 | if is_flat { s.lum.min } else { 0 };
    let low = _mm256_set1_epi32(low);
    let range = |p: &Plane| (_mm256_set1_epi32(p.min), _mm256_set1_epi32(p.max));
    let (z_range, lum_range) = (range(&s.depth), range(&s.lum));
    let at = (own.y0 - blocks.y0) as usize * blocks.width() + (own.x0 - blocks.x0) as usize;
    for row in keys[at..].chunks_mut(blocks.width()).take(own.height()) {
        let [mut e0, mut e1, mut e2] = edges.each_ref().map(|e| e.value);
        let (mut z, mut l) = (depth.value, lum.value);
        for (column, slot) in row[..own.width()].iter_mut().enumerate() {
            let outside = _mm256_srai_epi32::<31>(or(or(e0, e1), e2));
            let depth_bits = clamp(_mm256_srai_epi32::<{ DEPTH_BITS as i32 }>(z), z_range);
            let mut key = or(or(_mm256_slli_epi32::<16>(depth_bits), low), outside);
            if !is_flat {
                key = or(key, clamp(_mm256_srai_epi32::<{ LUM_BITS as i32 }>(l), lum_range));
                l = _mm256_add_epi32(l, lum.step_x);
            }
            let nearest = _mm256_min_epu32(lanes(slot), key);
            if let Some(brush) = &brush {
                let mut is_old = _mm256_cmpeq_epi32(nearest, lanes(slot));
                if _mm256_movemask_ps(_mm256_castsi256_ps(is_old)) != 0xff {
                    let (painted, is_hole) = brush.painted(nearest, column as i32);
                    is_old = or(is_old, is_hole);
                    let nearest = _mm256_blendv_epi8(nearest, lanes(slot), is_old);
                    *slot = bytemuck::cast(_mm256_blendv_epi8(painted, nearest, is_old));
                }
            } else {
                *slot = bytemuck::cast(nearest);
            }
            e0 = _mm256_add_epi32(e0, edges[0].step_x);
            e1 = _mm256_add_epi32(e1, edges[1].step_x);
            e2 = _mm256_add_epi32(e2, edges[2].step_x);
            z = _mm256_add_epi32(z, depth.step_x);
        }
        edges.iter_mut().for_each(|e| e.next_row());
        depth.next_row();
        lum.next_row();
        if let Some(brush) = &mut brush {
            brush.next_row();
        }
    }
}

/// An affine function at the pixels of the first block of a row.
#[derive(Clone, Copy)]
pub(super) struct Affine {
    pub(super) value: Lanes,
    /// From a block to its right neighbour.
    pub(super) step_x: Lanes,
    /// From a row of blocks to the one below.
    step_y: Lanes,
}

impl Affine {
    #[target_feature(enable = "avx2")]
    fn new([at_origin, dx, dy]: [i32; 3], i0: i32, j0: i32) -> Self {
        let corner = at_origin.wrapping_add(dx.wrapping_mul(i0)).wrapping_add(dy.wrapping_mul(j0));
        let (dx, dy) = (_mm256_set1_epi32(dx), _mm256_set1_epi32(dy));
        let across = _mm256_mullo_epi32(dx, _mm256_setr_epi32(0, 1, 2, 3, 0, 1, 2, 3));
        let down = _mm256_and_si256(dy, _mm256_setr_epi32(0, 0, 0, 0, -1, -1, -1, -1));
        let first = _mm256_add_epi32(_mm256_set1_epi32(corner), _mm256_add_epi32(across, down));
        // A block is 4 pixels wide and 2 high.
        Self {
            value: first,
            step_x: _mm256_slli_epi32::<2>(dx),
            step_y: _mm256_slli_epi32::<1>(dy),
        }
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn of_plane(p: &Plane, i0: i32, j0: i32) -> Self {
        Self::new([p.at_origin, p.dx, p.dy], i0, j0)
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn next_row(&mut self) {
        self.value = _mm256_add_epi32(self.value, self.step_y);
    }
}

/// The change of energy of one row of blocks, the first of which is block `first` of the picture.
#[target_feature(enable = "avx2")]
fn resolve_row<const IS_WEIGHED: bool>(
    of: &Judged<'_>,
    removed: &[[u32; LANES]],
    first: usize,
    coming: &[[u32; LANES]],
) -> i64 {
    let fronts = &of.lists.fronts()[first..][..coming.len()];
    let nothing = _mm256_set1_epi32(NOTHING as i32);
    // Each lane adds up a row of at most 256 blocks: less than 2^24, or 2^28 where pixels have weights.
    let (mut sums, mut odd) = (_mm256_setzero_si256(), 0);
    for (k, (front, key)) in fronts.iter().zip(coming).enumerate() {
        let gone = among(&front.face, removed);
        let key = lanes(key);
        let is_nothing = _mm256_cmpeq_epi32(key, nothing);
        let behind = _mm256_cmpgt_epi32(_mm256_srli_epi32::<16>(key), depths(front));
        let untouched = _mm256_andnot_si256(gone, or(is_nothing, behind));
        if _mm256_movemask_ps(_mm256_castsi256_ps(untouched)) == 0xff {
            continue;
        }
        let is_exposed = _mm256_testz_si256(gone, gone) == 0;
        let second = if is_exposed { &of.lists.seconds()[first + k] } else { front };
        let second_gone =
            if is_exposed { _mm256_and_si256(gone, among(&second.face, removed)) } else { gone };
        let stay_z = _mm256_blendv_epi8(depths(front), depths(second), gone);
        let stay_lum = _mm256_blendv_epi8(luminances(front.lum), luminances(second.lum), gone);
        let z = _mm256_srli_epi32::<16>(key);
        let wins = _mm256_andnot_si256(is_nothing, _mm256_cmpgt_epi32(stay_z, z));
        let ties = _mm256_andnot_si256(is_nothing, _mm256_cmpeq_epi32(stay_z, z));
        let lum = _mm256_and_si256(key, _mm256_set1_epi32(0xff));
        let lum = _mm256_blendv_epi8(stay_lum, lum, wins);
        let closer = or(second_gone, ties);
        let mut change = _mm256_sub_epi32(square(lum, front), square(luminances(front.lum), front));
        if IS_WEIGHED {
            change = _mm256_mullo_epi32(change, luminances(*of.lists.weights(first + k)));
        }
        sums = _mm256_add_epi32(sums, _mm256_andnot_si256(closer, change));
        if _mm256_testz_si256(closer, closer) == 0 {
            odd += look_closer(of, first + k, closer, [gone, second_gone], key);
        }
    }
    odd + bytemuck::cast::<_, [i32; LANES]>(sums).iter().map(|s| i64::from(*s)).sum::<i64>()
}

/// The change of energy of those pixels of a block whose two nearest fragments both go, or where
/// depths tie.
#[target_feature(enable = "avx2")]
fn look_closer(of: &Judged<'_>, block: usize, which: Lanes, gone: [Lanes; 2], key: Lanes) -> i64 {
    let bits = |mask: Lanes| _mm256_movemask_ps(_mm256_castsi256_ps(mask));
    let (mut left, gone) = (bits(which), gone.map(bits));
    let key: [u32; LANES] = bytemuck::cast(key);
    let mut sum = 0;
    while left != 0 {
        let lane = left.trailing_zeros() as usize;
        let n_gone = (gone[0] >> lane & 1) + (gone[1] >> lane & 1);
        sum += pixel_delta(of, block, lane, n_gone as usize, key[lane]);
        left &= left - 1;
    }
    sum
}

/// Which lanes hold one of the ids.
#[target_feature(enable = "avx2")]
fn among(face: &[u32; LANES], ids: &[[u32; LANES]]) -> Lanes {
    let face = lanes(face);
    let mut found = _mm256_setzero_si256();
    for id in ids {
        found = or(found, _mm256_cmpeq_epi32(face, lanes(id)));
    }
    found
}

#[target_feature(enable = "avx2")]
fn lanes(v: &[u32; LANES]) -> Lanes {
    bytemuck::cast(*v)
}

#[target_feature(enable = "avx2")]
fn or(a: Lanes, b: Lanes) -> Lanes {
    _mm256_or_si256(a, b)
}

#[target_feature(enable = "avx2")]
pub(super) fn clamp(v: Lanes, (min, max): (Lanes, Lanes)) -> Lanes {
    _mm256_min_epi32(_mm256_max_epi32(v, min), max)
}

#[target_feature(enable = "avx2")]
fn depths(block: &Block) -> Lanes {
    _mm256_cvtepu16_epi32(bytemuck::cast(block.depth))
}

#[target_feature(enable = "avx2")]
fn luminances(lum: [u8; LANES]) -> Lanes {
    _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(i64::from_le_bytes(lum)))
}

/// The squared difference to the reference picture.
#[target_feature(enable = "avx2")]
fn square(lum: Lanes, front: &Block) -> Lanes {
    let difference = _mm256_sub_epi32(lum, luminances(front.reference));
    _mm256_mullo_epi32(difference, difference)
}
