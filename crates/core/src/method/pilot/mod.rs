//! The pilot (5.9 of [method 5]): all views are matched once, in thumbnails, before anything is
//! ranked.
//!
//! A pilot map shows what no prediction does: a dense surface where there are no sparse points,
//! which map takes part where, and where pictures do not match. [`PilotMap`]s come from a plane
//! sweep against the planned partners (`sweep`); only what other maps confirm is kept (`confirm`);
//! and the [`Places`] on which they agree are what the ranking counts.
//!
//! ```text
//! cost of a plane   64 (1 − NCC)         mean of the three best partners, 5 × 5 pixels
//! depths agree      |z / z′ − 1| < max(1.5 %, ¼ step between planes), at most 3 %
//! place             one for each cube of edge 2 g,   g = 1.25 · finest GSD, a power of two
//! ```
//!
//! Depths z are along the axis of a thumbnail's camera, g, per pixel of the thumbnails, and the
//! cubes are in world coordinates, all in scene units.
//!
//! ```
//! use viewrank_core::base::progress::NoWatcher;
//! use viewrank_core::method::confidence::NoPictures;
//! use viewrank_core::method::pilot::{self, PilotMap, Places, Thumbnails};
//! use viewrank_core::model::arrays::{Intrinsics, SceneArrays};
//! use viewrank_core::model::{cluster::ViewCluster, scene::{Scene, ViewIndex}};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // Four views beside each other of a wall at z = 10. The map of the last has another depth.
//! let params = vec![140.0, 140.0, 80.0, 60.0];
//! let pose = |x: f64| [1., 0., 0., -x, 0., 1., 0., 0., 0., 0., 1., 0.];
//! let scene = Scene::from_arrays(&SceneArrays {
//!     cameras: vec![Intrinsics { model: "PINHOLE".into(), width: 160, height: 120, params }],
//!     names: ["a", "b", "c", "d"].map(String::from).to_vec(),
//!     camera: vec![0; 4],
//!     cam_from_world: [0.0, 1.0, 2.0, 3.0].map(pose).to_vec(),
//!     ..SceneArrays::default()
//! })?;
//! let views = [0, 1, 2, 3].map(ViewIndex);
//! let partners = |key| views.into_iter().filter(|&view| view != key).collect();
//! let clusters = views.map(|key| ViewCluster { key, partners: partners(key) });
//! let depths = [10.0, 10.0, 10.0, 5.0];
//! let made = views.map(|v| PilotMap::made_by_program(&scene, v, |_| Some(depths[v.index()])));
//! let (points, pictures, thumbnails) =
//!     (scene.view_points(), (&NoPictures as _, 1.0), Thumbnails::new(4));
//! let made = made.to_vec();
//! let maps = pilot::maps(&scene, &points, &clusters, made, thumbnails, pictures, &NoWatcher)?;
//! let places = Places::new(&clusters, maps, 2, 1.0, &NoWatcher)?;
//! assert!(places.centres.iter().all(|place| (place.z - 10.0).abs() < 1e-3));
//! assert!(!places.of_view(views[0]).is_empty() && places.of_view(views[3]).is_empty());
//! # Ok(())
//! # }
//! ```
//!
//! [method 5]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#5-ranking

mod aggregate;
mod confirm;
mod pinhole;
mod places;
mod sweep;
mod thumbnail;

use nalgebra::Point3;
use rayon::prelude::*;

pub use self::{
    pinhole::Pinhole,
    places::{Agreement, Part, Places},
    sweep::PilotMap,
    thumbnail::{PicturesWithThumbnails, Thumbnails},
};
use self::{
    sweep::{MOST_PLANES, Planes, Scratch},
    thumbnail::Thumbnail,
};
use super::confidence::Pictures;
use crate::{
    base::progress::{Cancelled, Stage, StepCounter, Watcher},
    model::{
        camera::Camera,
        cluster::ViewCluster,
        scene::{PointIndex, Scene, View, ViewIndex, ViewPoints},
    },
};

/// Matches each cluster in thumbnails, and finds the depths that other maps confirm. Thumbnails
/// that are missing are made of the pictures of the `source`, which are read for matching at this
/// size. Nothing is matched where a map is `made` already, one for each cluster.
///
/// Returns the maps of all clusters, one each: `None` without a thumbnail or sparse points.
pub fn maps(
    scene: &Scene,
    points: &ViewPoints,
    clusters: &[ViewCluster],
    made: Vec<Option<PilotMap>>,
    thumbnails: Thumbnails,
    source: (&dyn Pictures, f64),
    watcher: &dyn Watcher,
) -> Result<Vec<Option<PilotMap>>, Cancelled> {
    let unmatched = clusters
        .iter()
        .zip(&made)
        .filter(|(_, made)| made.is_none());
    let wanted = views_of(scene, unmatched.map(|(cluster, _)| cluster));
    wanted.par_iter().try_for_each(|&view| {
        watcher.check()?;
        thumbnails.read(scene, view, source);
        Ok(())
    })?;
    let steps = StepCounter::start(watcher, Stage::Pilot, clusters.len());
    let jobs = clusters.par_iter().zip(made);
    let matched = jobs.map_init(Scratch::default, |scratch, (cluster, made)| {
        let match_it = || map(scene, points, cluster, &thumbnails, scratch);
        steps.run(|| made.or_else(match_it))
    });
    let mut maps: Vec<Option<PilotMap>> = matched.collect::<Result<_, Cancelled>>()?;
    watcher.check()?;
    // No longer needed.
    drop(thumbnails);
    confirm::confirm(clusters, &mut maps, watcher)?;
    Ok(maps)
}

/// Returns the views of some clusters, ascending.
fn views_of<'a>(scene: &Scene, clusters: impl Iterator<Item = &'a ViewCluster>) -> Vec<ViewIndex> {
    let mut wanted = vec![false; scene.views.len()];
    for cluster in clusters {
        let views = cluster.partners.iter().chain([&cluster.key]);
        views.for_each(|view| wanted[view.index()] = true);
    }
    let views = scene.view_indices();
    views.filter(|view| wanted[view.index()]).collect()
}

/// Returns the size of the thumbnails over that of images matched at `image_scale`, for the largest
/// camera of the scene.
pub fn smaller(scene: &Scene, image_scale: f64) -> f64 {
    let sides = scene.cameras.iter();
    let side = sides.map(|camera| camera.width.max(camera.height)).max();
    thumbnail::LONG_SIDE / (f64::from(side.unwrap_or(1)) * image_scale)
}

/// Bytes per pixel of a thumbnail, with its mask, and of its map. The thumbnails are gone when the
/// maps are confirmed, which takes no more.
const VIEW_PIXEL: u64 = 1 + 1 + MAP_PIXEL;
/// Of these, the map, which is there until all places are found.
const MAP_PIXEL: u64 = 4;
/// Bytes per pixel while a view is matched: costs of the planes and their sums, rows of floats, and
/// the quads of as many partners as are usual.
const SWEPT_PIXEL: u64 = 3 * MOST_PLANES as u64 + 60 + 4 * USUAL_PARTNERS;
const USUAL_PARTNERS: u64 = 16;

/// Returns the memory of the thumbnails and maps of all views, of one view that is being matched,
/// and of the places with the tables that the ranking makes of them, bytes.
pub fn bytes(scene: &Scene) -> [u64; 3] {
    let pixels = |camera: &Camera| {
        let [width, height] = thumbnail::size(camera).map(|side| side as u64);
        width * height
    };
    let of_view = |view: &View| pixels(&scene.cameras[view.camera.index()]);
    let most = scene.cameras.iter().map(pixels).max().unwrap_or_default();
    let all = scene.views.iter().map(of_view).sum::<u64>();
    [
        VIEW_PIXEL * all,
        SWEPT_PIXEL * most,
        MAP_PIXEL * all + places::bytes(all as usize),
    ]
}

/// Share of the sparse points that may be outside the searched depths, at each end.
const OUTSIDE: f64 = 0.01;
/// Factors by which the searched depths are wider than those of the sparse points.
const WIDER: [f64; 2] = [0.75, 1.6];

fn map(
    scene: &Scene,
    points: &ViewPoints,
    cluster: &ViewCluster,
    thumbnails: &Thumbnails,
    scratch: &mut Scratch,
) -> Option<PilotMap> {
    let key = thumbnails.of_view(cluster.key)?;
    let partners = cluster.partners.iter();
    let partners: Vec<&Thumbnail> = partners
        .filter_map(|&view| thumbnails.of_view(view))
        .collect();
    if partners.is_empty() {
        return None;
    }
    let range = searched_depths(scene, points, cluster, key)?;
    let planes = Planes::new(key, &partners, range);
    Some(sweep::sweep(key, &partners, planes, scratch))
}

/// Returns the points that views of a cluster observe, ascending.
fn observed_by(cluster: &ViewCluster, points: &ViewPoints) -> Vec<PointIndex> {
    // What the partners observe counts too: the view itself may observe little of what it shows.
    let views = cluster.partners.iter().chain([&cluster.key]);
    let mut observed: Vec<_> = views
        .flat_map(|&view| points.observed_by(view).iter().copied())
        .collect();
    observed.sort_unstable();
    observed.dedup();
    observed
}

/// Returns the range of the depths of sparse points, somewhat widened; `None` without points.
fn searched_depths(
    scene: &Scene,
    points: &ViewPoints,
    cluster: &ViewCluster,
    key: &Thumbnail,
) -> Option<[f64; 2]> {
    let observed = observed_by(cluster, points);
    let depth = |point: Point3<f64>| key.camera.pixel(&point).map(|(_, z)| z);
    let depths = observed
        .iter()
        .filter_map(|point| depth(scene.points[point.index()]));
    let mut depths: Vec<f64> = depths.collect();
    if depths.is_empty() {
        return None;
    }
    depths.sort_by(f64::total_cmp);
    let at = |share: f64| depths[(share * (depths.len() - 1) as f64).round() as usize];
    Some([WIDER[0] * at(OUTSIDE), WIDER[1] * at(1.0 - OUTSIDE)])
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;
    use crate::{
        base::progress::NoWatcher,
        method::confidence::{Grey, Mask, NoPictures, PictureError},
        model::{
            camera::CameraModel,
            scene::{CameraIndex, Pose},
        },
    };

    /// Pictures of a ground with texture at z = 10, and of a wall 3 in front of it where x > 1.
    struct Stage;

    /// Depth of what a view shows at a pixel, and its grey level.
    fn shown(scene: &Scene, view: ViewIndex, x: f64, y: f64) -> (f64, u8) {
        let ray = scene.camera_of(view).ray(&[x, y].into()).unwrap();
        let centre = scene.view(view).cam_from_world.centre();
        let at = |z: f64| centre + ray.into_inner() * (z / ray.z);
        let (z, place) = if at(7.0).x > 1.0 {
            (7.0, at(7.0))
        } else {
            (10.0, at(10.0))
        };
        let wave = |f: f64, g: f64| (f * place.x + g * place.y).sin();
        let level =
            128.0 + 30.0 * (wave(9.0, 4.0) + wave(-5.0, 11.0) + wave(17.0, 13.0) * wave(3.0, -2.0));
        (z, level as u8)
    }

    impl Pictures for Stage {
        fn have_images(&self) -> bool {
            true
        }

        fn grey(
            &self,
            scene: &Scene,
            view: ViewIndex,
            _: f64,
        ) -> Result<Option<(Grey, Option<Mask>)>, PictureError> {
            let pixels = (0..120).flat_map(|y| (0..160).map(move |x| (x, y)));
            let level = |(x, y)| shown(scene, view, f64::from(x) + 0.5, f64::from(y) + 0.5).1;
            Ok(Some((
                Grey::new(160, 120, pixels.map(level).collect()),
                None,
            )))
        }

        fn mask(&self, _: &Scene, _: ViewIndex) -> Result<Option<Mask>, PictureError> {
            Ok(None)
        }
    }

    fn scene() -> (Scene, Vec<ViewCluster>) {
        let view = |i: u32| View {
            name: format!("{i}"),
            image_id: i,
            file_position: i,
            camera: CameraIndex(0),
            cam_from_world: Pose {
                rotation: Rotation3::identity(),
                translation: Vector3::new(-0.5 * f64::from(i), -0.3 * f64::from(i % 2), 0.0),
            },
        };
        let camera = Camera::new(
            1,
            CameraModel::Pinhole,
            160,
            120,
            vec![140.0, 140.0, 80.0, 60.0],
        );
        let points: Vec<Point3<f64>> = vec![[-1.0, 0.0, 10.0].into(), [1.5, 0.5, 7.0].into()];
        let scene = Scene {
            cameras: vec![camera.unwrap()],
            views: (0..4).map(view).collect(),
            track_offsets: (0..=points.len()).map(|point| 4 * point).collect(),
            track_views: (0..8).map(|i| ViewIndex(i % 4)).collect(),
            points,
            ..Scene::default()
        };
        let partners = |key: u32| (0..4).filter(|&view| view != key).map(ViewIndex).collect();
        let cluster = |key| ViewCluster {
            key: ViewIndex(key),
            partners: partners(key),
        };
        (scene, (0..4).map(cluster).collect())
    }

    fn matched(scene: &Scene, clusters: &[ViewCluster]) -> Vec<Option<PilotMap>> {
        let thumbnails = Thumbnails::new(scene.views.len());
        // One is there already, as after a comparison of the pictures.
        let beside = thumbnails.beside(&Stage);
        beside.grey(scene, ViewIndex(1), 1.0).unwrap();
        let made = vec![None; clusters.len()];
        let points = scene.view_points();
        let source = (&Stage as &dyn Pictures, 1.0);
        maps(
            scene, &points, clusters, made, thumbnails, source, &NoWatcher,
        )
        .unwrap()
    }

    #[test]
    fn maps_show_the_ground_and_the_wall() {
        let (scene, clusters) = scene();
        let maps = matched(&scene, &clusters);
        for (cluster, map) in clusters.iter().zip(&maps) {
            let map = map.as_ref().unwrap();
            let (mut right, mut wrong) = (0, 0);
            for (pixel, &inverse) in map.inverse.iter().enumerate().filter(|(_, v)| **v > 0.0) {
                let (x, y) = ((pixel % 160) as f64 + 0.5, (pixel / 160) as f64 + 0.5);
                let truth = shown(&scene, cluster.key, x, y).0;
                *(if (truth * f64::from(inverse) - 1.0).abs() < 0.02 {
                    &mut right
                } else {
                    &mut wrong
                }) += 1;
            }
            assert!(
                right > 160 * 120 / 2 && wrong < right / 50,
                "{right} right, {wrong} wrong"
            );
        }
        let places = Places::new(&clusters, maps, 2, 1.0, &NoWatcher).unwrap();
        assert!(places.centres.len() > 500);
        let near =
            |place: &&Point3<f64>| (place.z - 10.0).abs() < 0.3 || (place.z - 7.0).abs() < 0.3;
        let on_surface = places.centres.iter().filter(near).count();
        assert!(
            on_surface * 100 > places.centres.len() * 97,
            "{on_surface} of {}",
            places.centres.len()
        );
        // Most of what view 1 shows is in the maps of its neighbours too.
        assert!(
            places
                .agreement
                .iter()
                .filter(|&&agreement| agreement == Agreement::More)
                .count()
                * 2
                > places.centres.len()
        );
        let row = places.of_view(ViewIndex(1));
        assert!(
            row.windows(2).all(|two| two[0].place < two[1].place)
                && row.len() * 2 > places.centres.len()
        );
    }

    #[test]
    fn where_a_single_map_is_enough_it_gives_places_beside_the_confirmed_ones() {
        let (scene, clusters) = scene();
        let maps = matched(&scene, &clusters);
        let places =
            |support| Places::new(&clusters, maps.clone(), support, 1.0, &NoWatcher).unwrap();
        let (confirmed, all) = (places(2), places(1));
        let number = confirmed.centres.len();
        assert_eq!(all.centres[..number], confirmed.centres);
        assert_eq!(all.agreement[..number], confirmed.agreement);
        assert!(!confirmed.agreement.contains(&Agreement::Single));
        let beside = &all.agreement[number..];
        assert!(!beside.is_empty() && beside.iter().all(|&maps| maps == Agreement::Single));
        // Each is in a map at least.
        let shown = |places: &Places| places.parts.iter().map(Vec::len).sum::<usize>();
        assert!(shown(&all) >= shown(&confirmed) + beside.len());
        for parts in &all.parts {
            assert!(parts.windows(2).all(|two| two[0].place < two[1].place));
        }
    }

    #[test]
    fn maps_of_a_program_take_the_place_of_own_ones() {
        let (scene, clusters) = scene();
        let of_cluster = |cluster: &ViewCluster| {
            let z = |at: nalgebra::Point2<f64>| shown(&scene, cluster.key, at.x, at.y).0;
            let depth = |at: nalgebra::Point2<f64>| (at.x < 100.0).then(|| z(at));
            PilotMap::made_by_program(&scene, cluster.key, depth)
        };
        let maps = maps(
            &scene,
            &scene.view_points(),
            &clusters,
            clusters.iter().map(of_cluster).collect(),
            Thumbnails::new(scene.views.len()),
            (&NoPictures, 1.0),
            &NoWatcher,
        );
        for (cluster, map) in clusters.iter().zip(maps.unwrap()) {
            let inverse = map.unwrap().inverse;
            let kept = inverse.iter().enumerate().filter(|(_, v)| **v > 0.0);
            let right = |(pixel, inverse): &(usize, &f32)| {
                let (x, y) = ((pixel % 160) as f64 + 0.5, (pixel / 160) as f64 + 0.5);
                let truth = shown(&scene, cluster.key, x, y).0;
                x < 100.0 && (truth * f64::from(**inverse) - 1.0).abs() < 1e-5
            };
            let count = kept.clone().count();
            assert!(count > 90 * 120 / 2, "{count}");
            assert!(kept.filter(right).count() == count);
        }
    }

    #[test]
    fn a_view_without_points_or_partners_has_no_map() {
        let (mut scene, mut clusters) = scene();
        clusters[2].partners.clear();
        scene.points.clear();
        scene.track_views.clear();
        scene.track_offsets = vec![0];
        let found = matched(&scene, &clusters);
        assert_eq!(found, [None, None, None, None]);
        let places = Places::new(&clusters, found, 1, 1.0, &NoWatcher).unwrap();
        assert!(places.centres.is_empty());
    }
}
