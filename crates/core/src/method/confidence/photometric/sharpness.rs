//! Sharpness of the pictures, from the detail that each has left in its finest band (method 7.4).

use crate::{
    base::median::upper_median,
    model::scene::{Scene, ViewIndex},
};

/// Sharpness below which a picture is blurred, over the median of its camera's. On nine sets, no
/// picture had less than 0.71, and few more than this after blurring by a pixel.
const BLURRED: f64 = 0.6;
/// Pictures of a camera that have a median of their own.
const LEAST: usize = 5;

/// Sharpness of each picture over the median of those of its camera.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sharpness(Vec<Option<f64>>);

impl Sharpness {
    /// `detail`: by view, what [`Grey::detail`](super::Grey::detail) returns; zeros without a
    /// picture. What a picture shows is in both bands, blur takes from the first alone.
    pub fn new(scene: &Scene, detail: &[[f64; 2]]) -> Self {
        let of_view = |&[fine, coarse]: &[f64; 2]| (coarse > 0.0).then(|| fine / coarse);
        let own: Vec<Option<f64>> = detail.iter().map(of_view).collect();
        let medians = medians_by_camera(scene, &own);
        let relative = |(view, own): (usize, &Option<f64>)| {
            let median = medians[scene.views[view].camera.index()].filter(|&median| median > 0.0);
            Some((*own)? / median?)
        };
        Self(own.iter().enumerate().map(relative).collect())
    }

    /// Returns the view's sharpness, at most 1; 1 where it is not known.
    pub fn of(&self, view: ViewIndex) -> f64 {
        self.known(view).map_or(1.0, |sharpness| sharpness.min(1.0))
    }

    fn known(&self, view: ViewIndex) -> Option<f64> {
        self.0.get(view.index()).copied().flatten()
    }

    /// Returns the views whose picture is blurred, ascending.
    pub fn blurred(&self) -> impl Iterator<Item = ViewIndex> {
        let views = (0..self.0.len() as u32).map(ViewIndex);
        views.filter(|&view| self.known(view).is_some_and(|own| own < BLURRED))
    }
}

/// Returns the median of each camera's pictures, that of all pictures where a camera has few.
fn medians_by_camera(scene: &Scene, own: &[Option<f64>]) -> Vec<Option<f64>> {
    let all = upper_median(own.iter().copied().flatten());
    let mut by_camera: Vec<Vec<f64>> = vec![Vec::new(); scene.cameras.len()];
    for (view, own) in scene.views.iter().zip(own) {
        by_camera[view.camera.index()].extend(own);
    }
    let of_camera = |values: Vec<f64>| match values.len() {
        0..LEAST => all,
        _ => upper_median(values),
    };
    by_camera.into_iter().map(of_camera).collect()
}

#[cfg(test)]
mod tests {
    use super::{super::Grey, *};
    use crate::model::{
        camera::{Camera, CameraModel},
        scene::{CameraIndex, Pose, View},
    };

    /// A picture of noise, averaged over squares of `2 blur + 1` pixels.
    fn picture(seed: u32, blur: i64) -> Grey {
        const SIDE: i64 = 64;
        let noise = |x: i64, y: i64| {
            let cell = (x.rem_euclid(SIDE) + SIDE * y.rem_euclid(SIDE)) as u32;
            (cell ^ seed).wrapping_mul(2_654_435_761).rotate_left(11) % 256
        };
        let mean = |x: i64, y: i64| {
            let near = (-blur..=blur).flat_map(|dy| (-blur..=blur).map(move |dx| (dx, dy)));
            let sum: u32 = near.map(|(dx, dy)| noise(x + dx, y + dy)).sum();
            (sum / (2 * blur + 1).pow(2) as u32) as u8
        };
        let pixels = (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y)));
        Grey::new(64, 64, pixels.map(|(x, y)| mean(x, y)).collect())
    }

    fn scene(cameras: &[u32]) -> Scene {
        let camera = |id| {
            Camera::new(
                id,
                CameraModel::Pinhole,
                64,
                64,
                vec![64.0, 64.0, 32.0, 32.0],
            )
            .unwrap()
        };
        let view = |&camera: &u32| View {
            name: String::new(),
            image_id: 0,
            file_position: 0,
            camera: CameraIndex(camera),
            cam_from_world: Pose {
                rotation: nalgebra::Rotation3::identity(),
                translation: nalgebra::Vector3::zeros(),
            },
        };
        Scene {
            cameras: [0, 1].map(camera).to_vec(),
            views: cameras.iter().map(view).collect(),
            ..Scene::default()
        }
    }

    #[test]
    fn blurred_pictures_are_found_whatever_they_show() {
        let scene = scene(&[0; 12]);
        let blur = |view: u32| i64::from([3, 7].contains(&view));
        let mut detail: Vec<_> = (0..12).map(|v| picture(v, blur(v)).detail()).collect();
        detail[9] = [0.0; 2];
        let sharpness = Sharpness::new(&scene, &detail);
        let blurred: Vec<_> = sharpness.blurred().collect();
        assert_eq!(blurred, [3, 7].map(ViewIndex));
        assert!(sharpness.of(ViewIndex(3)) < BLURRED);
        assert_eq!(sharpness.of(ViewIndex(9)), 1.0, "unknown");
    }

    #[test]
    fn a_softer_camera_is_no_blurred_picture() {
        let detail = |v: u32| picture(v, i64::from(v >= 6)).detail();
        let detail: Vec<_> = (0..12).map(detail).collect();
        let cameras: Vec<u32> = (0..12).map(|v| u32::from(v >= 6)).collect();
        let of = |cameras: &[u32]| Sharpness::new(&scene(cameras), &detail);
        assert_eq!(of(&cameras).blurred().count(), 0);
        // One camera for both: the sharper half is the norm, or the softer.
        assert!([0, 6].contains(&of(&[0; 12]).blurred().count()));
    }
}
