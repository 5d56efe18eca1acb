//! The table against brute force: a ray from the camera to the centroid of each triangle, past all
//! the others.

use super::{
    estimator::{hit, is_share_free},
    *,
};
use crate::{
    base::progress::NoWatcher,
    method::synthetic::Town,
    model::camera::{Camera, CameraModel},
};

fn camera(model: CameraModel, params: &[f64]) -> Camera {
    Camera::new(1, model, 1000, 750, params.to_vec()).unwrap()
}

fn pinhole() -> Camera {
    camera(CameraModel::Pinhole, &[850.0, 850.0, 500.0, 375.0])
}

/// By the definition, with one sample: the centroid.
fn sees_centroid(
    scene: &Scene,
    surface: &Surface,
    view: ViewIndex,
    t: u32,
    max_incidence_deg: f64,
) -> bool {
    let (pose, camera) = (&scene.view(view).cam_from_world, scene.camera_of(view));
    let (centre, centroid) = (pose.centre(), surface.centroid(t));
    let towards = (centre - centroid).normalize();
    let pixel = camera.project(&pose.camera_from_world(&centroid));
    surface.area_normal(t).normalize().dot(&towards) > max_incidence_deg.to_radians().cos()
        && pixel.is_some_and(|p| camera.contains(&p))
        && !(0..surface.triangles.len() as u32)
            .filter(|&o| o != t)
            .any(|o| {
                let corners = surface.corners(o).map(|v| Point3::from(v - centre));
                hit(&corners, &(centroid - centre)).is_some_and(|share| share < 1.0 - 1e-9)
            })
}

/// Precision and recall of the table against the centroids' rays.
fn agreement(town: &Town, edge_length: f64) -> (f64, f64) {
    let (scene, surface) = (town.scene(), town.surface());
    let settings = VisibilitySettings::default();
    let table = estimate(
        &scene,
        &scene.view_points(),
        &surface,
        &settings,
        edge_length,
        Storage::Memory,
        &NoWatcher,
    )
    .unwrap();
    let (mut both, mut said, mut true_ones) = (0.0, 0.0, 0.0);
    for view in scene.view_indices().step_by(17) {
        for t in 0..surface.triangles.len() as u32 {
            let truth = sees_centroid(&scene, &surface, view, t, settings.max_incidence_deg);
            let ours = table.row(view, t).is_some();
            both += f64::from(u8::from(truth && ours));
            said += f64::from(u8::from(ours));
            true_ones += f64::from(u8::from(truth));
        }
    }
    assert!(true_ones > 1000.0);
    (both / said, both / true_ones)
}

#[test]
fn agrees_with_rays_for_all_kinds_of_cameras() {
    let cameras = [
        pinhole(),
        camera(
            CameraModel::OpenCv,
            &[800.0, 820.0, 510.0, 370.0, -0.2, 0.05, 0.001, -0.002],
        ),
        camera(CameraModel::SimpleRadial, &[850.0, 500.0, 375.0, 0.15]),
        camera(
            CameraModel::OpenCvFisheye,
            &[500.0, 500.0, 500.0, 375.0, 0.01, -0.005, 0.0, 0.0],
        ),
        camera(CameraModel::SimpleFisheye, &[330.0, 500.0, 375.0]),
        Camera::new(
            1,
            CameraModel::Equirectangular,
            1000,
            500,
            vec![1000.0, 500.0],
        )
        .unwrap(),
    ];
    for camera in cameras {
        let model = camera.model();
        let (precision, recall) = agreement(
            &Town {
                points: 200,
                ..Town::new(camera)
            },
            2.0,
        );
        assert!(
            precision >= 0.97 && recall >= 0.97,
            "{model:?}: {precision} {recall}"
        );
    }
}

/// All cases of four points.
#[test]
fn a_share_is_free_whatever_is_not_looked_at() {
    for share in [0.0, 0.25, 1.0 / 3.0, 0.5, 0.75, 0.9, 1.0] {
        for case in 0..81u32 {
            let points = [1, 3, 9, 27]
                .map(|digit| [None, Some(false), Some(true)][(case / digit % 3) as usize]);
            let samples = points.iter().flatten().count() as u32;
            let free = points.iter().filter(|&&point| point == Some(true)).count() as u32;
            let expected = samples > 0 && f64::from(free) >= share * f64::from(samples);
            assert_eq!(
                is_share_free(share, points.into_iter()),
                expected,
                "{share} of {points:?}"
            );
        }
    }
}

/// Layers below the ground, which fill each picture.
#[test]
fn a_heap_of_layers_is_refused_whatever_its_triangles_cost() {
    let town = Town::default();
    let scene = town.scene();
    let with_layers = |layers: u32| {
        let mut surface = town.surface();
        for layer in 0..layers {
            let (z, first) = (-10.0 - f64::from(layer), surface.vertices.len() as u32);
            let corners = [[-1e5, -1e5], [1e5, -1e5], [1e5, 1e5], [-1e5, 1e5]];
            let corner = |[x, y]: [f64; 2]| Point3::new(x, y, z);
            surface.vertices.extend(corners.map(corner));
            surface
                .triangles
                .extend([[0, 1, 2], [0, 2, 3]].map(|t| t.map(|v| first + v)));
        }
        let settings = VisibilitySettings {
            buffer_px: 100,
            ..VisibilitySettings::default()
        };
        estimate(
            &scene,
            &scene.view_points(),
            &surface,
            &settings,
            town.edge,
            Storage::Memory,
            &NoWatcher,
        )
    };
    assert!(with_layers(100).is_ok());
    let refused = with_layers(300);
    let first = scene.name(ViewIndex(0));
    assert!(
        matches!(&refused, Err(VisibilityError::Layers { view }) if view == first),
        "{refused:?}"
    );
}
