//! Which edges stand where the pictures differ most.
//!
//! Squared differences are blurred in every view by one step down and up a pyramid with the 5 × 5
//! Gaussian of Burt & Adelson 1983 (9 × 9 in effect); every vertex collects what lies under its
//! projections, whether or not it is seen there, and an edge has the sum of its ends (Lindstrom &
//! Turk 2000, section 7.1.6).

use crate::{
    mesh::{EdgeTable, EditMesh, VertexId},
    metric::Objective,
    render::RenderError,
};

/// The kernel of the pyramid, in sixteenths.
const KERNEL: [f32; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];

/// A picture of numbers, `size`² of them.
struct Plane {
    size: usize,
    values: Vec<f32>,
}

/// The edges of a mesh, the most promising first. Empty where no reference is known.
pub fn ranking(
    mesh: &EditMesh,
    edges: &EdgeTable,
    objective: &mut Objective,
) -> Result<Vec<[VertexId; 2]>, RenderError> {
    let Some(potential) = potentials(mesh, objective)? else { return Ok(Vec::new()) };
    let of = |ends: [VertexId; 2]| ends.iter().map(|v| potential[v.index()]).sum::<f64>();
    let mut all: Vec<(f64, [VertexId; 2])> =
        edges.edges().map(|e| edges.ends(e)).map(|ends| (of(ends), ends)).collect();
    all.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    Ok(all.into_iter().map(|(_, ends)| ends).collect())
}

/// By vertex: blurred squared differences under it, summed over the views.
fn potentials(mesh: &EditMesh, objective: &mut Objective) -> Result<Option<Vec<f64>>, RenderError> {
    let mut sums = vec![0.0; mesh.n_vertex_slots()];
    for view in 0..objective.scene().n_views() {
        let shown = objective.picture(view)?;
        let Some(reference) = objective.reference() else { return Ok(None) };
        let scene = objective.scene();
        let mut differences =
            squares(&shown, &reference.pictures[view], scene.lattice.size as usize);
        for (difference, w) in
            differences.values.iter_mut().zip(reference.weights_in(view).into_iter().flatten())
        {
            *difference *= f32::from(*w);
        }
        let blurred = expand(&reduce(&differences), differences.size);
        for (v, sum) in sums.iter_mut().enumerate() {
            let p = scene.views[view].project(mesh.position(VertexId(v as u32)));
            *sum += f64::from(scene.views[view].weight) * f64::from(blurred.at(p.x, p.y));
        }
    }
    Ok(Some(sums))
}

fn squares(a: &[u8], b: &[u8], size: usize) -> Plane {
    let square = |(a, b): (&u8, &u8)| f32::from(a.abs_diff(*b)).powi(2);
    Plane { size, values: a.iter().zip(b).map(square).collect() }
}

impl Plane {
    /// The value at a place given in 0..1; 0 outside.
    fn at(&self, x: f64, y: f64) -> f32 {
        let (i, j) = (x * self.size as f64, y * self.size as f64);
        if i < 0.0 || j < 0.0 || i >= self.size as f64 || j >= self.size as f64 {
            return 0.0;
        }
        self.values[j as usize * self.size + i as usize]
    }

    /// Rows become columns.
    fn transposed(&self) -> Self {
        let n = self.size;
        let rows = self.values.len().checked_div(n).unwrap_or(0);
        let at = |k: usize| self.values[k % rows * n + k / rows];
        Self { size: rows, values: (0..self.values.len()).map(at).collect() }
    }
}

/// Half as many numbers in each row, and then in each column.
fn reduce(plane: &Plane) -> Plane {
    let half = |p: &Plane| {
        let n = p.size;
        let of_row = |row: &[f32]| -> Vec<f32> {
            (0..n.div_ceil(2)).map(|i| weigh(row, 2 * i as isize)).collect()
        };
        Plane { size: n.div_ceil(2), values: p.values.chunks(n).flat_map(of_row).collect() }
    };
    half(&half(plane).transposed()).transposed()
}

/// The mean around a place of a row, weighted by the kernel; the row's ends are repeated.
fn weigh(row: &[f32], center: isize) -> f32 {
    let last = row.len() as isize - 1;
    let value = |k: isize| row[(center + k - 2).clamp(0, last) as usize];
    KERNEL.iter().zip(0..).map(|(w, k)| w * value(k)).sum()
}

/// Twice as many numbers in each row and column, `size` of them.
fn expand(plane: &Plane, size: usize) -> Plane {
    let double = |p: &Plane| {
        let of_row = |row: &[f32]| -> Vec<f32> { (0..size).map(|i| between(row, i)).collect() };
        Plane { size, values: p.values.chunks(p.size).flat_map(of_row).collect() }
    };
    double(&double(plane).transposed()).transposed()
}

/// The kernel's taps that fall on the coarser row: three at even places, two at odd ones.
fn between(row: &[f32], i: usize) -> f32 {
    let at = |k: usize| row[k.min(row.len() - 1)];
    let k = i / 2;
    if i.is_multiple_of(2) {
        2.0 * (KERNEL[0] * at(k.saturating_sub(1)) + KERNEL[2] * at(k) + KERNEL[4] * at(k + 1))
    } else {
        2.0 * (KERNEL[1] * at(k) + KERNEL[3] * at(k + 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blurring_keeps_flat_pictures_and_spreads_points() {
        let flat = Plane { size: 16, values: vec![3.0; 256] };
        let blurred = expand(&reduce(&flat), 16);
        assert!(blurred.values.iter().all(|v| (v - 3.0).abs() < 1e-5));
        let mut point = Plane { size: 16, values: vec![0.0; 256] };
        point.values[8 * 16 + 8] = 256.0;
        let blurred = expand(&reduce(&point), 16);
        let sum: f32 = blurred.values.iter().sum();
        assert!((sum - 256.0).abs() < 1.0, "{sum}");
        let reach = (0..16).filter(|i| blurred.values[8 * 16 + i] > 0.0).count();
        assert!((7..=9).contains(&reach), "{reach}");
        assert!(blurred.values.iter().all(|v| *v <= blurred.values[8 * 16 + 8]));
    }

    #[test]
    fn places_outside_the_picture_count_nothing() {
        let plane = Plane { size: 4, values: (0..16).map(|i| i as f32).collect() };
        assert_eq!((plane.at(0.0, 0.0), plane.at(0.99, 0.99)), (0.0, 15.0));
        assert_eq!((plane.at(-0.01, 0.5), plane.at(0.5, 1.0)), (0.0, 0.0));
        assert_eq!(plane.transposed().at(0.3, 0.9), plane.at(0.9, 0.3));
    }
}
