//! Time of the pilot: milliseconds of one core per view, for thumbnails of a textured ground with
//! five partners each.
//!
//!     cargo bench -p viewrank-core --bench pilot

use std::time::Instant;

use nalgebra::{Point3, Rotation3, Vector3};
use viewrank_core::{
    base::progress::NoWatcher,
    method::{
        confidence::{Grey, Mask, PictureError, Pictures},
        pilot,
    },
    model::{
        camera::{Camera, CameraModel},
        cluster::ViewCluster,
        scene::{CameraIndex, Pose, Scene, View, ViewIndex},
    },
};

const VIEWS: u32 = 12;
const SIZE: [u32; 2] = [160, 120];

/// Pictures of a ground at z = 10.
struct Ground;

impl Pictures for Ground {
    fn have_images(&self) -> bool {
        true
    }

    fn grey(
        &self,
        scene: &Scene,
        view: ViewIndex,
        _: f64,
    ) -> Result<Option<(Grey, Option<Mask>)>, PictureError> {
        let centre = scene.view(view).cam_from_world.centre();
        let level = |(x, y): (u32, u32)| {
            let ray = scene
                .camera_of(view)
                .ray(&[f64::from(x), f64::from(y)].into())
                .unwrap();
            let place = centre + ray.into_inner() * (10.0 / ray.z);
            let wave = |f: f64, g: f64| (f * place.x + g * place.y).sin();
            (128.0 + 40.0 * (wave(9.0, 4.0) + wave(-5.0, 11.0))) as u8
        };
        let pixels = (0..SIZE[1]).flat_map(|y| (0..SIZE[0]).map(move |x| (x, y)));
        let grey = Grey::new(
            SIZE[0] as usize,
            SIZE[1] as usize,
            pixels.map(level).collect(),
        );
        Ok(Some((grey, None)))
    }

    fn mask(&self, _: &Scene, _: ViewIndex) -> Result<Option<Mask>, PictureError> {
        Ok(None)
    }
}

/// Cameras in rows of four above the ground.
fn scene() -> Scene {
    let view = |i: u32| View {
        name: format!("{i}"),
        image_id: i,
        file_position: i,
        camera: CameraIndex(0),
        cam_from_world: Pose {
            rotation: Rotation3::identity(),
            translation: Vector3::new(-f64::from(i % 4), -f64::from(i / 4), 0.0),
        },
    };
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        160,
        120,
        vec![140.0, 140.0, 80.0, 60.0],
    );
    // Depths from 6 to 11 units: about a hundred planes.
    let points: Vec<Point3<f64>> = vec![[1.5, 1.0, 6.0].into(), [1.5, 1.0, 11.0].into()];
    Scene {
        cameras: vec![camera.unwrap()],
        views: (0..VIEWS).map(view).collect(),
        track_offsets: (0..=points.len())
            .map(|point| VIEWS as usize * point)
            .collect(),
        track_views: (0..2 * VIEWS).map(|i| ViewIndex(i % VIEWS)).collect(),
        points,
        ..Scene::default()
    }
}

fn main() {
    let scene = scene();
    let partners = |key: u32| (1..=5).map(|i| ViewIndex((key + i) % VIEWS)).collect();
    let clusters: Vec<ViewCluster> = (0..VIEWS)
        .map(|key| ViewCluster {
            key: ViewIndex(key),
            partners: partners(key),
        })
        .collect();
    let points = scene.view_points();
    let one = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    one.install(|| {
        let start = Instant::now();
        let thumbnails = pilot::Thumbnails::new(scene.views.len());
        let pictures = (&Ground as &dyn Pictures, 1.0);
        let maps = pilot::maps(
            &scene,
            &points,
            &clusters,
            vec![None; clusters.len()],
            thumbnails,
            pictures,
            &NoWatcher,
        );
        let maps = maps.unwrap();
        let matched = start.elapsed();
        let places = pilot::Places::new(&clusters, maps, 2, 1.0, &NoWatcher).unwrap();
        let counted = start.elapsed() - matched;
        let ms = |time: std::time::Duration| 1e3 * time.as_secs_f64() / f64::from(VIEWS);
        println!("maps    {:6.1} ms per view", ms(matched));
        println!(
            "places  {:6.1} ms per view, {} places",
            ms(counted),
            places.centres.len()
        );
    });
}
