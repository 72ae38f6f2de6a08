//! Generated meshes, for tests and benches: known topology, known counts, no files.

use std::f64::consts::{PI, TAU};

use glam::DVec3;

use super::model::Mesh;

/// A grid of `n_u` × `n_v` quads, two triangles each, on the surface that `place` describes over
/// (u, v) in 0..=1; each direction may close on itself.
pub fn grid(
    [n_u, n_v]: [u32; 2],
    [wraps_u, wraps_v]: [bool; 2],
    place: impl Fn(f64, f64) -> DVec3,
) -> Mesh {
    let [columns, rows] = [n_u + u32::from(!wraps_u), n_v + u32::from(!wraps_v)];
    let mut positions = Vec::with_capacity((columns * rows) as usize);
    for row in 0..rows {
        for column in 0..columns {
            let [u, v] = [f64::from(column) / f64::from(n_u), f64::from(row) / f64::from(n_v)];
            positions.push(place(u, v));
        }
    }
    let mut faces = Vec::with_capacity((2 * n_u * n_v) as usize);
    for row in 0..n_v {
        for column in 0..n_u {
            let id = |c: u32, r: u32| (r % rows) * columns + c % columns;
            let [a, b] = [id(column, row), id(column + 1, row)];
            let [d, c] = [id(column, row + 1), id(column + 1, row + 1)];
            faces.extend([[a, b, c], [a, c, d]]);
        }
    }
    Mesh::from_parts(positions, faces)
}

/// A torus of radii 1 and 0.4 with a ripple of the given depth, closed: 2·n_u·n_v triangles.
pub fn torus(n_u: u32, n_v: u32, ripple: f64) -> Mesh {
    grid([n_u, n_v], [true, true], |u, v| {
        let (around, across) = (TAU * u, TAU * v);
        let r = 0.4 + ripple * (5.0 * around).sin() * (3.0 * across).cos();
        let ring = 1.0 + r * across.cos();
        DVec3::new(ring * around.cos(), ring * around.sin(), r * across.sin())
    })
}

/// The spherical segment between latitudes 30° and 60° of the unit sphere, open at both ends:
/// 33 latitudes × 256 longitudes, 16,384 triangles (Lindstrom & Turk 1999, section 6.3).
pub fn spherical_segment() -> Mesh {
    grid([256, 32], [true, false], |u, v| {
        let (longitude, latitude) = (TAU * u, PI / 6.0 * (1.0 + v));
        let r = latitude.cos();
        DVec3::new(r * longitude.cos(), r * longitude.sin(), latitude.sin())
    })
}

/// A square of side 1 with hills of the given height, open: 2·n² triangles.
pub fn terrain(n: u32, height: f64) -> Mesh {
    grid([n, n], [false, false], |u, v| {
        DVec3::new(u, v, height * ((9.0 * u).sin() * (7.0 * v).cos() + (31.0 * u * v).sin() / 5.0))
    })
}

/// The regular octahedron: 8 triangles, closed.
pub fn octahedron() -> Mesh {
    let positions = [DVec3::Z, DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y, -DVec3::Z];
    let faces = (0..4u32).flat_map(|i| {
        let [a, b] = [1 + i, 1 + (i + 1) % 4];
        [[0, a, b], [5, b, a]]
    });
    Mesh::from_parts(positions.to_vec(), faces.collect())
}

/// A sphere: the octahedron with each triangle cut in four `levels` times. 8·4^levels triangles.
pub fn sphere(levels: u32) -> Mesh {
    let mut mesh = octahedron();
    for _ in 0..levels {
        let mut midpoints = std::collections::BTreeMap::new();
        let mut faces = Vec::with_capacity(mesh.faces.len() * 4);
        for [a, b, c] in mesh.faces {
            let [ab, bc, ca] = [(a, b), (b, c), (c, a)].map(|(p, q)| {
                *midpoints.entry((p.min(q), p.max(q))).or_insert_with(|| {
                    let sum = mesh.positions[p as usize] + mesh.positions[q as usize];
                    mesh.positions.push(sum.normalize_or_zero());
                    mesh.positions.len() as u32 - 1
                })
            });
            faces.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        mesh.faces = faces;
    }
    mesh
}
