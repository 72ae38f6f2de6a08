//! All levels in one file, and at which size on the screen each takes over.

use crate::io::{self, GlbLevel, GlbOptions, IoError};

use super::{
    levels::{Level, Levels},
    switching::screen_coverage,
};

/// `lods.glb`, where there are several levels of different sizes; `distances` are their switch
/// distances in the order asked for.
pub(super) fn file(
    levels: &Levels,
    distances: &[Option<f64>],
    options: GlbOptions,
) -> Result<Option<Vec<u8>>, IoError> {
    let mut chain: Vec<(&Level, Option<f64>)> =
        levels.in_order().zip(distances.iter().copied()).collect();
    let n_faces = |level: &Level| level.mesh.faces.len();
    chain.sort_by_key(|(level, _)| std::cmp::Reverse(n_faces(level)));
    chain.dedup_by_key(|(level, _)| n_faces(level));
    if chain.len() < 2 {
        return Ok(None);
    }
    let distances: Vec<_> = chain.iter().map(|(_, distance)| *distance).collect();
    let names: Vec<String> = chain.iter().map(|(level, _)| level.name()).collect();
    let rows = chain.iter().zip(&names).zip(coverages(&distances));
    let levels: Vec<_> = rows
        .map(|(((level, _), name), screen_coverage)| GlbLevel {
            name,
            mesh: &level.mesh,
            screen_coverage,
        })
        .collect();
    io::write_lods(&levels, options).map(Some)
}

/// The share of the screen's height down to which each level is shown, finest first: that at which
/// the next one, and all between, may stand in for the original; 0 for the last. A level whose
/// distance is not known is not shown.
fn coverages(distances: &[Option<f64>]) -> Vec<f64> {
    let mut farthest = 0.0_f64;
    let nexts = distances.iter().skip(1);
    let mut coverages: Vec<f64> = nexts
        .map(|distance| {
            farthest = farthest.max(distance.unwrap_or(f64::INFINITY));
            screen_coverage(farthest)
        })
        .collect();
    coverages.push(0.0);
    coverages
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At 3.4641 radii the sphere, 2 radii high, takes half of 2 × 3.4641 × tan 30°.
    #[test]
    fn coverage_falls_from_level_to_level() {
        let half = 2.0 * 3.0_f64.sqrt();
        for (distances, expected) in [
            (&[Some(5.0)][..], &[0.0][..]),
            (&[Some(5.0), Some(half)], &[0.5, 0.0]),
            (&[Some(5.0), Some(2.0 * half), Some(half)], &[0.25, 0.25, 0.0]),
            (&[None, Some(0.0), Some(half)], &[1.0, 0.5, 0.0]),
            (&[None, Some(half), None, Some(2.0 * half)], &[0.5, 0.0, 0.0, 0.0]),
        ] {
            let found = coverages(distances);
            assert_eq!(found.len(), expected.len());
            let pairs = found.iter().zip(expected);
            assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-12), "{distances:?}: {found:?}");
        }
    }
}
