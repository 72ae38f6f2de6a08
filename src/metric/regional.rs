//! Where on a surface the pictures' energy has changed.

use rayon::prelude::*;

use crate::render::{Reference, Scene};

use super::{drawn::Drawn, shown::Shown};

/// The region of what belongs to none.
pub const NOWHERE: u32 = u32::MAX;

/// How much more energy the pictures of the second scene have than those of the first, by region; both scenes come with
/// the region of each triangle. A pixel counts for the region that is seen in it before or after, half for each if these are
/// two. Sums run in view order, so they do not depend on threads.
pub fn changes_by_region(
    scenes: [(&Scene, &[u32]); 2],
    reference: &Reference,
    n_regions: usize,
) -> Vec<f64> {
    let views = &scenes[0].0.views;
    let of_view = |view: usize| {
        let mut sums = vec![0.0; n_regions];
        let drawn = scenes.map(|(scene, _)| Drawn::new(scene, view, None));
        let shown = Shown::of(reference, view);
        for (pixel, target) in shown.picture.iter().enumerate() {
            let ids = [0, 1].map(|k| drawn[k].id(pixel));
            let region = |k: usize| scenes[k].1.get(ids[k] as usize).copied().unwrap_or(NOWHERE);
            let regions = [region(0), region(1)];
            if regions == [NOWHERE; 2] {
                continue;
            }
            let [before, after] =
                [0, 1].map(|k| (drawn[k].luminance(ids[k], pixel) - f64::from(*target)).powi(2));
            let change = f64::from(views[view].weight) * shown.weight(pixel) * (after - before);
            let n_seen = regions.iter().filter(|r| **r != NOWHERE).count() as f64;
            for region in regions {
                if let Some(sum) = sums.get_mut(region as usize) {
                    *sum += change / n_seen;
                }
            }
        }
        sums
    };
    let parts: Vec<Vec<f64>> = (0..views.len()).into_par_iter().map(of_view).collect();
    let mut sums = vec![0.0; n_regions];
    for part in parts {
        sums.iter_mut().zip(part).for_each(|(sum, one)| *sum += one);
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        mesh::{EditMesh, VertexId, shapes},
        metric::{Pictures, bounding_sphere, reference_pictures, scene_as_drawn, slopes},
        render::{
            RenderParams, Shading,
            view::{Projection, ViewParams, cameras, directions},
        },
    };

    #[test]
    fn regions_add_up_to_the_whole_and_those_without_a_change_have_none() {
        let original = shapes::torus(24, 16, 0.2);
        let view_params = ViewParams {
            directions: directions(6).unwrap(),
            fov_degrees: 60.0,
            projection: Projection::Perspective,
            light_degrees: 10.0,
        };
        let params = RenderParams {
            image_size: 64,
            shading: Shading::Flat,
            ambient: 0.1,
            background: 128,
            interior_views: 0,
            hides_back_faces: false,
        };
        let sphere = bounding_sphere(&original);
        let pictures = Pictures::of(&original, params, cameras(&sphere, &view_params));
        let reference = reference_pictures(&original, &pictures);
        let before = EditMesh::new(shapes::torus(12, 8, 0.0)).unwrap();
        let mut after = before.clone();
        // One vertex in each of the regions 0 and 1; nothing happens in 2.
        let vertices = [VertexId(0), VertexId(50)];
        for v in vertices {
            after.displace(v, 1.1 * before.position(v));
        }
        let region = |f| {
            let is_at = |v: &VertexId| before.faces_around(*v).contains(&f);
            vertices.iter().position(is_at).unwrap_or(2) as u32
        };
        let regions: Vec<u32> = before.faces().map(region).collect();
        let scenes = [&before, &after].map(|mesh| scene_as_drawn(mesh, &pictures, false));
        let energies = [0, 1].map(|k| slopes(&scenes[k], &reference, false, None).energy);
        let labelled = [0, 1].map(|k| (&scenes[k], &regions[..]));
        let changes = changes_by_region(labelled, &reference, 3);
        let sum: f64 = changes.iter().sum();
        assert!((sum - (energies[1] - energies[0])).abs() < 1e-6 * energies[0], "{changes:?}");
        assert!(changes[0] != 0.0 && changes[1] != 0.0, "{changes:?}");
        // Nothing but what the others have hidden of it, or hide no longer: half of that is theirs.
        assert!(changes[2].abs() < 0.2 * (changes[0].abs() + changes[1].abs()), "{changes:?}");
        let nothing = changes_by_region([labelled[0]; 2], &reference, 3);
        assert_eq!(nothing, [0.0; 3]);
        let apart: Vec<u32> = regions.iter().map(|r| if *r == 1 { 0 } else { NOWHERE }).collect();
        let one = changes_by_region(scenes.each_ref().map(|s| (s, &apart[..])), &reference, 1);
        assert!(one[0] != 0.0, "{one:?}");
    }
}
