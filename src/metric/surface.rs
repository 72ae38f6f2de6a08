//! Distance between two surfaces, as the tool Metro defines it.
//!
//! Points are spread evenly by area over each surface; from each the exact distance to the other
//! surface is taken. The mean is that of the points' distances; for the maximum, the vertices
//! count too. "Symmetric" is the mean, or the maximum, of the two directions.
//!
//! Invariants:
//! 1. figures are percent of the diagonal of the original's bounding box;
//! 2. the same seed gives the same figures, on any number of threads.
//!
//! Source: Cignoni, Rocchini & Scopigno, Metro: measuring error on simplified surfaces, 1998.

use std::convert::Infallible;

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::bvh::{Bvh, Triangle, bounds};
use crate::mesh::Mesh;

/// How closely to measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SurfaceParams {
    /// Points on each surface.
    pub samples: u32,
    /// Seed of where in its stretch of area each point lies.
    pub seed: u64,
}

impl Default for SurfaceParams {
    fn default() -> Self {
        Self { samples: 500_000, seed: 1 }
    }
}

/// Distances in percent of the diagonal of the original's bounding box.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SurfaceDistance {
    /// Mean of the two directions' means.
    pub mean: f64,
    /// Root of the mean of the two directions' mean squares.
    pub rms: f64,
    /// Larger of the two directions' maxima.
    pub max: f64,
    /// Mean distance from points of the original to the simplified surface.
    pub mean_original_to_simplified: f64,
    /// Mean distance from points of the simplified surface to the original.
    pub mean_simplified_to_original: f64,
    /// Largest distance from a point or vertex of the original to the simplified surface.
    pub max_original_to_simplified: f64,
    /// Largest distance from a point or vertex of the simplified surface to the original.
    pub max_simplified_to_original: f64,
    /// Points on each surface.
    pub samples_per_direction: u32,
}

/// Measures both directions. None when a mesh has no triangles or the original has no extent.
pub fn surface_distance(
    original: &Mesh,
    simplified: &Mesh,
    params: &SurfaceParams,
) -> Option<SurfaceDistance> {
    let Ok(found) = try_surface_distance(original, simplified, params, NEVER_ENDS);
    found
}

/// [`surface_distance`], which `tick` hears of from any thread: that the work on so large a share of the points
/// begins. Its error ends the work.
pub fn try_surface_distance<E: Send>(
    original: &Mesh,
    simplified: &Mesh,
    params: &SurfaceParams,
    tick: &(dyn Fn(f64) -> Result<(), E> + Sync),
) -> Result<Option<SurfaceDistance>, E> {
    let ((a, tree_a), (b, tree_b)) = rayon::join(|| prepare(original), || prepare(simplified));
    let (low, high) = bounds(a.iter().flatten().copied());
    let diagonal = (high - low).length();
    if a.is_empty() || b.is_empty() || diagonal <= 0.0 {
        return Ok(None);
    }
    let half = |share: f64| tick(share / 2.0);
    let forth = one_direction(original, &a, &tree_b, (params, &half))?;
    let back = one_direction(simplified, &b, &tree_a, (params, &half))?;
    let percent = |distance: f64| 100.0 * distance / diagonal;
    Ok(Some(SurfaceDistance {
        mean: percent(f64::midpoint(forth.mean, back.mean)),
        rms: percent(f64::midpoint(forth.mean_square, back.mean_square).sqrt()),
        max: percent(forth.max.max(back.max)),
        mean_original_to_simplified: percent(forth.mean),
        mean_simplified_to_original: percent(back.mean),
        max_original_to_simplified: percent(forth.max),
        max_simplified_to_original: percent(back.max),
        samples_per_direction: params.samples,
    }))
}

/// Hears nothing, ends nothing.
const NEVER_ENDS: &(dyn Fn(f64) -> Result<(), Infallible> + Sync) = &|_| Ok(());

/// An original to measure many meshes by, by evenly spread points alone: quicker than
/// [`surface_distance`] for each.
pub struct Ruler {
    triangles: Vec<Triangle>,
    tree: Bvh,
    params: SurfaceParams,
}

impl Ruler {
    /// Gets ready to measure.
    pub fn new(original: &Mesh, params: SurfaceParams) -> Self {
        let (triangles, tree) = prepare(original);
        Self { triangles, tree, params }
    }

    /// Mean of the two directions' mean distances, in the model's units. None when a mesh has no triangles.
    pub fn mean(&self, simplified: &Mesh) -> Option<f64> {
        if self.triangles.is_empty() || simplified.faces.is_empty() {
            return None;
        }
        let (triangles, tree) = prepare(simplified);
        let mean = |from: &[Triangle], to: &Bvh| {
            let n = self.params.samples.max(1) as usize;
            let spread = Spread::new(from, n, self.params.seed);
            let Ok(sums) = sums_over_runs(n, |i| spread.point(from, i), to, NEVER_ENDS);
            sums.distance / n as f64
        };
        Some(f64::midpoint(mean(&self.triangles, &tree), mean(&triangles, &self.tree)))
    }
}

struct Direction {
    mean: f64,
    mean_square: f64,
    max: f64,
}

/// Sums over a run of points.
#[derive(Clone, Copy, Default)]
struct Sums {
    distance: f64,
    distance2: f64,
    max2: f64,
}

/// Points a task handles one after the other: neighbours on the surface, so that the triangle
/// nearest to one is a good hint for the next.
const RUN: usize = 2048;

fn prepare(mesh: &Mesh) -> (Vec<Triangle>, Bvh) {
    let corner = |v: u32| mesh.positions[v as usize];
    let triangles: Vec<Triangle> = mesh.faces.iter().map(|f| f.map(corner)).collect();
    (triangles.clone(), Bvh::new(triangles))
}

fn one_direction<E: Send>(
    from: &Mesh,
    triangles: &[Triangle],
    to: &Bvh,
    (params, tick): (&SurfaceParams, &(dyn Fn(f64) -> Result<(), E> + Sync)),
) -> Result<Direction, E> {
    let n = params.samples.max(1) as usize;
    let spread = Spread::new(triangles, n, params.seed);
    let mut used = vec![false; from.positions.len()];
    from.faces.iter().flatten().for_each(|v| used[*v as usize] = true);
    let vertices: Vec<DVec3> =
        from.positions.iter().zip(used).filter_map(|(p, used)| used.then_some(*p)).collect();
    let share_of_points = n as f64 / (n + vertices.len()) as f64;
    let of_points = |share: f64| tick(share * share_of_points);
    let of_vertices = |share: f64| tick(share * (1.0 - share_of_points));
    let evenly = sums_over_runs(n, |i| spread.point(triangles, i), to, &of_points)?;
    let at_vertices = sums_over_runs(vertices.len(), |i| vertices[i], to, &of_vertices)?;
    Ok(Direction {
        mean: evenly.distance / n as f64,
        mean_square: evenly.distance2 / n as f64,
        max: evenly.max2.max(at_vertices.max2).sqrt(),
    })
}

/// Sums of runs of fixed length, added in order: the same on any number of threads.
fn sums_over_runs<E: Send>(
    n: usize,
    point: impl Fn(usize) -> DVec3 + Sync,
    to: &Bvh,
    tick: &(dyn Fn(f64) -> Result<(), E> + Sync),
) -> Result<Sums, E> {
    let n_runs = n.div_ceil(RUN);
    let run = |first: usize| {
        tick(1.0 / n_runs as f64)?;
        let (mut sums, mut hint) = (Sums::default(), usize::MAX);
        for i in first..(first + RUN).min(n) {
            let nearest = to.nearest(point(i), hint);
            hint = nearest.triangle;
            sums.distance += nearest.distance2.sqrt();
            sums.distance2 += nearest.distance2;
            sums.max2 = sums.max2.max(nearest.distance2);
        }
        Ok(sums)
    };
    let runs: Result<Vec<Sums>, E> = (0..n_runs).into_par_iter().map(|k| run(k * RUN)).collect();
    Ok(runs?.iter().fold(Sums::default(), |all, s| Sums {
        distance: all.distance + s.distance,
        distance2: all.distance2 + s.distance2,
        max2: all.max2.max(s.max2),
    }))
}

/// An even spread of points: the surface's area is laid out in a line, cut into as many equal
/// stretches as there are points, and each stretch gets one.
struct Spread {
    area_up_to: Vec<f64>,
    n: usize,
    seed: u64,
}

impl Spread {
    fn new(triangles: &[Triangle], n: usize, seed: u64) -> Self {
        let mut total = 0.0;
        let running = |[a, b, c]: &Triangle| {
            total += (*b - *a).cross(*c - *a).length();
            total
        };
        Self { area_up_to: triangles.iter().map(running).collect(), n, seed }
    }

    fn point(&self, triangles: &[Triangle], i: usize) -> DVec3 {
        let total = self.area_up_to.last().copied().unwrap_or(0.0);
        let [along, u, v] = [0, 1, 2].map(|k| unit_random(self.seed, 3 * i as u64 + k));
        let at = (i as f64 + along) / self.n as f64 * total;
        let triangle = self.area_up_to.partition_point(|area| *area <= at);
        let [a, b, c] = triangles[triangle.min(triangles.len() - 1)];
        // The half of the parallelogram beyond the triangle is folded back onto it.
        let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
        a + (b - a) * u + (c - a) * v
    }
}

/// The `index`-th number of a seeded sequence, 0 ≤ x < 1.
fn unit_random(seed: u64, index: u64) -> f64 {
    let bits = mixed(mixed(seed).wrapping_add(index.wrapping_mul(GOLDEN)));
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// The output function of SplitMix64 (Steele, Lea & Flood 2014).
fn mixed(state: u64) -> u64 {
    let mut z = state.wrapping_add(GOLDEN);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of side 1 at the given height.
    fn square(height: f64) -> Mesh {
        let corner = |x: f64, y: f64| DVec3::new(x, y, height);
        Mesh::from_parts(
            vec![corner(0.0, 0.0), corner(1.0, 0.0), corner(1.0, 1.0), corner(0.0, 1.0)],
            vec![[0, 1, 2], [0, 2, 3]],
        )
    }

    fn few() -> SurfaceParams {
        SurfaceParams { samples: 10_000, seed: 7 }
    }

    #[test]
    fn parallel_squares_are_their_offset_apart() {
        let d = surface_distance(&square(0.0), &square(0.25), &few()).unwrap();
        let percent = 100.0 * 0.25 / 2.0_f64.sqrt();
        for value in [d.mean, d.rms, d.max, d.max_simplified_to_original] {
            assert!((value - percent).abs() < 1e-9, "{d:?}");
        }
    }

    #[test]
    fn a_hole_is_seen_from_one_side_only() {
        // Half of the square is missing: points over the gap are up to 1/√2 from the diagonal,
        // 1/(3√2) on average over that half.
        let mut half = square(0.0);
        half.faces.pop();
        let d = surface_distance(&square(0.0), &half, &few()).unwrap();
        assert!(d.mean_simplified_to_original.max(d.max_simplified_to_original) < 1e-12);
        assert!((d.max - 50.0).abs() < 1e-9);
        assert!((d.mean_original_to_simplified - 100.0 / 12.0).abs() < 0.3, "{d:?}");
        assert!((d.mean - d.mean_original_to_simplified / 2.0).abs() < 1e-12);
    }

    #[test]
    fn points_are_spread_evenly_by_area() {
        // A triangle nine times as large as the other gets nine tenths of the points.
        let small = [DVec3::ZERO, DVec3::X, DVec3::Y];
        let large = small.map(|p| p * 3.0 + DVec3::Z);
        let spread = Spread::new(&[small, large], 1000, 3);
        let points: Vec<DVec3> = (0..1000).map(|i| spread.point(&[small, large], i)).collect();
        assert_eq!(points.iter().filter(|p| p.z > 0.5).count(), 900);
        let center = points[100..].iter().sum::<DVec3>() / 900.0;
        assert!(center.distance(DVec3::new(1.0, 1.0, 1.0)) < 0.1, "{center}");
    }

    #[test]
    fn the_seed_alone_decides() {
        let (a, b) = (square(0.0), Mesh { faces: vec![[0, 1, 2]], ..square(0.1) });
        let once = surface_distance(&a, &b, &few());
        assert_eq!(once, surface_distance(&a, &b, &few()));
        assert_ne!(once, surface_distance(&a, &b, &SurfaceParams { seed: 8, ..few() }));
    }

    #[test]
    fn whoever_hears_of_it_hears_of_all_of_it_and_may_end_it() {
        use std::sync::Mutex;

        let (a, b) = (square(0.0), square(0.1));
        let (heard, most) = (Mutex::new(0.0), Mutex::new(f64::INFINITY));
        let tick = |share: f64| {
            let mut heard = heard.lock().unwrap();
            *heard += share;
            if *heard > *most.lock().unwrap() { Err("enough") } else { Ok(()) }
        };
        let measured = try_surface_distance(&a, &b, &few(), &tick);
        assert_eq!(measured, Ok(surface_distance(&a, &b, &few())));
        assert!((*heard.lock().unwrap() - 1.0).abs() < 1e-9);
        *most.lock().unwrap() = 1.5;
        assert_eq!(try_surface_distance(&a, &b, &few(), &tick), Err("enough"));
    }

    #[test]
    fn nothing_has_no_distance() {
        assert!(surface_distance(&Mesh::default(), &square(0.0), &few()).is_none());
        assert!(surface_distance(&square(0.0), &Mesh::default(), &few()).is_none());
        let mut point = square(0.0);
        point.positions.iter_mut().for_each(|p| *p = DVec3::ONE);
        assert!(surface_distance(&point, &square(0.0), &few()).is_none());
    }
}
