//! The parts of a mesh that a view could see.

use nalgebra::Point3;
use rayon::prelude::*;

use super::{
    buffer::Face,
    patches::{Patch, Patches},
};
use crate::{
    base::{
        connected::components,
        progress::{Cancelled, Watcher},
    },
    model::{
        mesh::Mesh,
        scene::{Scene, View},
        surface::{Surface, SurfaceKind},
    },
};

/// Drops the connected components of a mesh outside all views, before the costly clean-up.
/// `buffer_px`: side of the depth buffers, as in [`VisibilitySettings`](super::VisibilitySettings).
pub fn keep_parts_in_field(
    scene: &Scene,
    mesh: Mesh,
    buffer_px: u32,
    watcher: &dyn Watcher,
) -> Result<Mesh, Cancelled> {
    let surface = Surface {
        kind: SurfaceKind::Mesh,
        vertices: mesh.vertices,
        triangles: mesh.triangles,
    };
    let in_field = triangles_in_field(scene, &surface, buffer_px, watcher)?;
    let Surface {
        vertices,
        mut triangles,
        ..
    } = surface;
    if in_field.contains(&false) {
        let kept = whole_parts(&triangles, vertices.len(), &in_field);
        let mut kept = kept.iter();
        triangles.retain(|_| *kept.next().expect("one flag per triangle"));
    }
    Ok(Mesh {
        vertices,
        triangles,
    })
}

/// Returns for each triangle whether it may be in the field of a view.
fn triangles_in_field(
    scene: &Scene,
    surface: &Surface,
    buffer_px: u32,
    watcher: &dyn Watcher,
) -> Result<Vec<bool>, Cancelled> {
    let cameras = scene.cameras.par_iter();
    let faces: Vec<Vec<Face>> = cameras.map(|c| Face::covering(c, buffer_px)).collect();
    let meets = |view: &View, centre: &Point3<f64>, radius: f64| {
        let centre = view.cam_from_world.camera_from_world(centre);
        let mut faces = faces[view.camera.index()].iter();
        faces.any(|face| face.meets(&centre, radius))
    };
    let patches = Patches::new(surface);
    let in_field = |patch: &Patch| {
        watcher.check()?;
        let views = scene.views.iter();
        let views: Vec<&View> = views
            .filter(|view| meets(view, &patch.centre, patch.radius))
            .collect();
        // A patch may have triangles far from each other, where the mesh has a gap.
        let is_in_field = |&t: &u32| {
            let centre = surface.centroid(t);
            let to_corners = surface.corners(t).map(|corner| (corner - centre).norm());
            let radius = to_corners.into_iter().fold(0.0, f64::max);
            views.iter().any(|view| meets(view, &centre, radius))
        };
        let triangles = patches.triangle_indices(patch).iter();
        Ok(triangles.map(is_in_field).collect())
    };
    let by_patch = patches.patches.par_iter().map(in_field);
    let by_patch = by_patch.collect::<Result<Vec<Vec<bool>>, Cancelled>>()?;
    let mut in_field = vec![false; surface.triangles.len()];
    for (patch, of_patch) in patches.patches.iter().zip(by_patch) {
        let triangles = patches.triangle_indices(patch).iter();
        triangles
            .zip(of_patch)
            .for_each(|(&t, is_in_field)| in_field[t as usize] = is_in_field);
    }
    Ok(in_field)
}

/// Returns for each triangle whether it, or another that it is connected with by vertices, counts.
fn whole_parts(triangles: &[[u32; 3]], vertices: usize, counts: &[bool]) -> Vec<bool> {
    let mut last_at = vec![0; vertices];
    for (t, corners) in (0..).zip(triangles) {
        corners.iter().for_each(|&v| last_at[v as usize] = t);
    }
    let beside = |t: u32| {
        let corners = triangles[t as usize];
        // All triangles at a vertex are connected through the last one, without a list of those at
        // each.
        corners.map(|v| last_at[v as usize]).into_iter()
    };
    let mut kept = counts.to_vec();
    for part in components(triangles.len(), beside) {
        let counts = part.iter().any(|&t| counts[t as usize]);
        part.iter().for_each(|&t| kept[t as usize] = counts);
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{base::progress::NoWatcher, method::synthetic::Town, model::surface::shapes};

    #[test]
    fn a_part_that_no_view_could_see_is_dropped_and_the_rest_is_as_it_was() {
        let town = Town::default();
        let (scene, near) = (town.scene(), town.surface());
        let far = shapes::sphere(4);
        let in_sight = Mesh {
            vertices: near.vertices,
            triangles: near.triangles,
        };
        let mut mesh = in_sight.clone();
        let offset = mesh.vertices.len() as u32;
        let high_above = nalgebra::Vector3::new(0.0, 0.0, 1e4);
        mesh.vertices
            .extend(far.vertices.iter().map(|v| v + high_above));
        let far = far.triangles.iter();
        mesh.triangles.extend(far.map(|t| t.map(|v| v + offset)));
        let keep = |mesh| keep_parts_in_field(&scene, mesh, 700, &NoWatcher).unwrap();
        assert_eq!(keep(mesh.clone()).triangles, in_sight.triangles);
        // Of a part that is partly in sight nothing is dropped.
        mesh.triangles.push([0, 1, offset]);
        assert_eq!(keep(mesh.clone()), mesh);
    }
}
