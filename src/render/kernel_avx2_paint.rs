//! [`super::paint`], eight pixels at a time.

use std::arch::x86_64::{
    __m128i, __m256i, _mm_set1_epi64x, _mm256_add_epi32, _mm256_and_si256, _mm256_castsi256_si128,
    _mm256_cmpgt_epi32, _mm256_cvtepi32_pd, _mm256_cvttpd_epi32, _mm256_div_pd,
    _mm256_extracti128_si256, _mm256_max_epi32, _mm256_min_epi32, _mm256_mullo_epi32,
    _mm256_or_si256, _mm256_set_m128i, _mm256_set1_epi32, _mm256_set1_pd, _mm256_setzero_si256,
    _mm256_sll_epi32, _mm256_srai_epi32, _mm256_srli_epi32, _mm256_sub_epi32,
};

use super::{
    fragments::{BLOCK_HEIGHT, BLOCK_WIDTH, LANES},
    kernel_avx2::{Affine, Lanes, clamp},
    paint::{Holes, PAINT_BITS, Painted, dither},
};

/// A texture on a triangle, at the blocks of a row.
pub(super) struct Brush<'a> {
    texels: &'a [u32],
    planes: [Affine; 3],
    ranges: [(Lanes, Lanes); 3],
    from: [Lanes; 2],
    to: [[Lanes; 2]; 2],
    bounds: [(Lanes, Lanes); 2],
    masks: [Lanes; 2],
    width_bits: __m128i,
    at: usize,
    holes: Option<Holes>,
    glow_at: Option<usize>,
    /// The first pixel of the row's first block.
    corner: [i32; 2],
}

impl<'a> Brush<'a> {
    /// At the first block of the first row.
    #[target_feature(enable = "avx2")]
    pub(super) fn new(paint: &Painted, texels: &'a [u32], i0: i32, j0: i32) -> Self {
        let all = |v: i32| _mm256_set1_epi32(v);
        Self {
            texels,
            planes: paint.planes.map(|p| Affine::of_plane(&p, i0, j0)),
            ranges: paint.planes.map(|p| (all(p.min), all(p.max))),
            from: paint.from.map(all),
            to: paint.to.map(|corner| corner.map(all)),
            bounds: paint.range.map(|[low, high]| (all(low), all(high))),
            masks: paint.bits.map(|b| all((1 << b) - 1)),
            width_bits: _mm_set1_epi64x(i64::from(paint.bits[0])),
            at: paint.at as usize,
            holes: paint.holes,
            glow_at: paint.glow_at.map(|at| at.get() as usize),
            corner: [i0, j0],
        }
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn next_row(&mut self) {
        self.planes.iter_mut().for_each(|p| p.next_row());
        self.corner[1] += BLOCK_HEIGHT;
    }

    /// The keys of block `column` of the row, their luminances seen through the texture, with what it gives off; and
    /// where it has holes.
    #[target_feature(enable = "avx2")]
    pub(super) fn painted(&self, keys: Lanes, column: i32) -> (Lanes, Lanes) {
        let place = self.coordinates(column);
        let low = _mm256_set1_epi32(0xff);
        let lum = _mm256_and_si256(keys, low);
        let product = _mm256_mullo_epi32(
            _mm256_mullo_epi32(lum, self.look_up(self.at, place)),
            _mm256_set1_epi32(257),
        );
        let mut lum = _mm256_srli_epi32::<16>(_mm256_add_epi32(product, _mm256_set1_epi32(32_768)));
        if let Some(glow_at) = self.glow_at {
            lum = _mm256_min_epi32(_mm256_add_epi32(lum, self.look_up(glow_at, place)), low);
        }
        let painted = _mm256_or_si256(_mm256_sub_epi32(keys, _mm256_and_si256(keys, low)), lum);
        let is_hole = match self.holes {
            None => _mm256_setzero_si256(),
            Some(holes) => {
                let least = if holes.least == 0 {
                    self.dither(column)
                } else {
                    _mm256_set1_epi32(holes.least as i32)
                };
                _mm256_cmpgt_epi32(least, self.look_up(holes.at as usize, place))
            }
        };
        (painted, is_hole)
    }

    /// The least alphas of a dithered surface.
    #[target_feature(enable = "avx2")]
    fn dither(&self, column: i32) -> Lanes {
        let [i0, j0] = [self.corner[0] + column * BLOCK_WIDTH, self.corner[1]];
        let least: [u32; LANES] = std::array::from_fn(|lane| {
            let lane = lane as i32;
            dither(i0 + lane % BLOCK_WIDTH, j0 + lane / BLOCK_WIDTH)
        });
        bytemuck::cast(least)
    }

    /// What lies at these coordinates, of the level that begins at a word.
    #[target_feature(enable = "avx2")]
    fn look_up(&self, first: usize, [x, y]: [Lanes; 2]) -> Lanes {
        let row = _mm256_and_si256(_mm256_srai_epi32::<6>(y), self.masks[1]);
        let texel = _mm256_add_epi32(
            _mm256_sll_epi32(row, self.width_bits),
            _mm256_and_si256(_mm256_srai_epi32::<6>(x), self.masks[0]),
        );
        let texel: [u32; LANES] = bytemuck::cast(texel);
        let four = texel.map(|t| self.texels.get(first + t as usize).copied().unwrap_or(u32::MAX));
        let four: Lanes = bytemuck::cast(four);
        let byte = |shifted: Lanes| _mm256_and_si256(shifted, _mm256_set1_epi32(0xff));
        let (a, b) = (byte(four), byte(_mm256_srli_epi32::<8>(four)));
        let (c, d) = (byte(_mm256_srli_epi32::<16>(four)), _mm256_srli_epi32::<24>(four));
        let part = |v: Lanes| _mm256_and_si256(v, _mm256_set1_epi32(63));
        let (fx, fy) = (part(x), part(y));
        let between =
            _mm256_add_epi32(mixed(mixed(a, b, fx), mixed(c, d, fx), fy), _mm256_set1_epi32(2048));
        _mm256_srli_epi32::<12>(between)
    }

    /// Texel coordinates in 64ths.
    #[target_feature(enable = "avx2")]
    fn coordinates(&self, column: i32) -> [Lanes; 2] {
        let mut at = [self.from[0]; 3];
        for (k, at) in at.iter_mut().enumerate() {
            let plane = &self.planes[k];
            let by = _mm256_mullo_epi32(plane.step_x, _mm256_set1_epi32(column));
            let value = _mm256_add_epi32(plane.value, by);
            *at = clamp(_mm256_srai_epi32::<{ PAINT_BITS as i32 }>(value), self.ranges[k]);
        }
        let [near, one, two] = at;
        let per_near = divided(_mm256_max_epi32(near, _mm256_set1_epi32(1)));
        let share = |v: Lanes| _mm256_srli_epi32::<14>(_mm256_mullo_epi32(v, per_near));
        let (one, two) = (share(one), share(two));
        let mut found = self.from;
        for (axis, found) in found.iter_mut().enumerate() {
            let by = _mm256_add_epi32(
                _mm256_mullo_epi32(one, self.to[0][axis]),
                _mm256_mullo_epi32(two, self.to[1][axis]),
            );
            let by = _mm256_srai_epi32::<15>(_mm256_add_epi32(by, _mm256_set1_epi32(1 << 14)));
            let (low, high) = self.bounds[axis];
            let place = _mm256_add_epi32(*found, by);
            *found = _mm256_min_epi32(_mm256_max_epi32(place, low), high);
        }
        found
    }
}

/// 2^29 divided by numbers of at most 2^14, which double precision does exactly but for the fraction.
#[target_feature(enable = "avx2")]
fn divided(by: Lanes) -> Lanes {
    let half = |four: __m128i| {
        _mm256_cvttpd_epi32(_mm256_div_pd(
            _mm256_set1_pd(f64::from(1 << 29)),
            _mm256_cvtepi32_pd(four),
        ))
    };
    let (low, high) = (_mm256_castsi256_si128(by), _mm256_extracti128_si256::<1>(by));
    _mm256_set_m128i(half(high), half(low))
}

/// 64 times the mean of two, of which the second has `share` 64ths.
#[target_feature(enable = "avx2")]
fn mixed(a: Lanes, b: Lanes, share: __m256i) -> Lanes {
    let rest = _mm256_sub_epi32(_mm256_set1_epi32(64), share);
    _mm256_add_epi32(_mm256_mullo_epi32(a, rest), _mm256_mullo_epi32(b, share))
}
