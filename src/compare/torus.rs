//! A textured torus: what Lindstrom's Figure 27 shows of optimized texture coordinates, made anew.
//!
//! An ellipse that spins once while it is swept round a circle; black numbers, coloured squares and lines on white,
//! on which distortion is easily seen; texture coordinates that are far from linear.
//!
//! Knows nothing of files.

use std::{f64::consts::TAU, sync::Arc};

use glam::DVec3;

use super::canvas::{Canvas, Rgb};
use crate::mesh::{AttributeLayer, Image, Material, Mesh, Pixels, Semantic, Texture, TextureUse};

/// Points around and across: 33,173, as many vertices as the paper's model has.
const N_AROUND: u32 = 677;
const N_ACROSS: u32 = 49;
/// Pixels along a side of the texture.
const SIDE: usize = 1024;
const WHITE: Rgb = [255; 3];
const BLACK: Rgb = [0; 3];
const SQUARES: [Rgb; 4] = [[214, 40, 40], [30, 110, 200], [40, 150, 70], [240, 180, 30]];

/// The torus, some three units across, 66,346 triangles.
pub fn textured_torus() -> Mesh {
    let mut mesh = Mesh::default();
    for i in 0..N_AROUND {
        mesh.positions.extend((0..N_ACROSS).map(|j| place(share(i, N_AROUND), share(j, N_ACROSS))));
    }
    let mut coordinates = Vec::new();
    for i in 0..=N_AROUND {
        let around = share(i, N_AROUND);
        let across = (0..=N_ACROSS).map(|j| share(j, N_ACROSS));
        coordinates.extend(across.flat_map(|a| [bent(around, 0.07), bent(a, 0.06)]));
    }
    let vertex = |i: u32, j: u32| i % N_AROUND * N_ACROSS + j % N_ACROSS;
    let wedge = |i: u32, j: u32| i * (N_ACROSS + 1) + j;
    for i in 0..N_AROUND {
        for j in 0..N_ACROSS {
            let corners = [(i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)];
            for triangle in [[0, 1, 2], [0, 2, 3]] {
                let of = |f: &dyn Fn(u32, u32) -> u32| {
                    triangle.map(|k: usize| f(corners[k].0, corners[k].1))
                };
                mesh.faces.push(of(&vertex));
                mesh.face_wedges.push(of(&wedge));
            }
        }
    }
    let semantic = Semantic::TexCoord(0);
    mesh.layers = vec![AttributeLayer { semantic, width: 2, values: coordinates }];
    paint(&mut mesh);
    mesh
}

fn share(k: u32, n: u32) -> f64 {
    f64::from(k) / f64::from(n)
}

fn place(around: f64, across: f64) -> DVec3 {
    let (sin_a, cos_a) = libm::sincos(TAU * around);
    let (sin_b, cos_b) = libm::sincos(TAU * across);
    // The ellipse in its own axes, then spun by as much as it has been swept.
    let (x, y) = (0.5 * cos_b, 0.22 * sin_b);
    let (out, up) = (x * cos_a - y * sin_a, x * sin_a + y * cos_a);
    DVec3::new((1.0 + out) * cos_a, up, (1.0 + out) * sin_a)
}

/// A coordinate that runs by turns faster and slower.
fn bent(t: f64, by: f64) -> f32 {
    (t + by * libm::sin(TAU * 2.0 * t)) as f32
}

fn paint(mesh: &mut Mesh) {
    let canvas = picture();
    let rgba = canvas.pixels().iter().flat_map(|[r, g, b]| [*r, *g, *b, 255]).collect();
    let side = SIDE as u32;
    mesh.images = vec![Image {
        name: "numbers".into(),
        mime: "image/png".into(),
        bytes: canvas.png().into(),
        pixels: Some(Arc::new(Pixels { width: side, height: side, rgba })),
    }];
    mesh.textures = vec![Texture { image: Some(0), ..Texture::default() }];
    let transform = TextureUse::IDENTITY;
    mesh.materials = vec![Material {
        name: "numbers".into(),
        base_texture: Some(TextureUse { texture: 0, tex_coord: 0, transform }),
        double_sided: false,
        ..Material::default()
    }];
}

/// Four rows of numbers and squares between lines.
fn picture() -> Canvas {
    let mut canvas = Canvas::new(SIDE, SIDE, WHITE);
    let cell = SIDE / 4;
    for k in 0..16 {
        let (x, y) = (k % 4 * cell, k / 4 * cell);
        if (k + k / 4) % 2 == 0 {
            canvas.text(x + cell / 4, y + cell / 8, 3 * cell / 4, BLACK, &(k % 10).to_string());
        } else {
            fill(
                &mut canvas,
                (x + cell / 4, y + cell / 4),
                (cell / 2, cell / 2),
                SQUARES[k / 2 % 4],
            );
        }
    }
    for line in 0..8 {
        let colour = if line % 2 == 0 { BLACK } else { SQUARES[line / 2] };
        fill(&mut canvas, (line * SIDE / 8, 0), (8, SIDE), colour);
        fill(&mut canvas, (0, line * SIDE / 8), (SIDE, 8), colour);
    }
    canvas
}

fn fill(canvas: &mut Canvas, at: (usize, usize), size: (usize, usize), colour: Rgb) {
    for y in at.1..at.1 + size.1 {
        (at.0..at.0 + size.0).for_each(|x| canvas.set(x, y, colour));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_papers_size_closed_and_textured() {
        let mesh = textured_torus();
        mesh.check().unwrap();
        assert_eq!((mesh.positions.len(), mesh.faces.len()), (33_173, 66_346));
        let mesh = crate::mesh::EditMesh::new(mesh).unwrap();
        assert!((0..100).all(|v| !mesh.is_border_vertex(crate::mesh::VertexId(v * 331))));
        let uv = &mesh.mesh().layers[0].values;
        assert!(uv.iter().all(|c| (0.0..=1.0).contains(c)));
    }
}
