//! Numbers that can't be true: units, cameras, poses, images of another size.

use super::{Finding, Severity, Visit, counted};
use crate::scene::{PointIndex, Units, ViewIndex};

/// Ground sampling distances of any survey, metres: from a microscope to a satellite.
const METRIC_GSD: std::ops::RangeInclusive<f64> = 1e-6..=100.0;
/// The wanted ground sampling distance is not so many times another than the images'.
const WANTED_RATIO: f64 = 20.0;
/// Fields of view of any camera, degrees.
const FIELD: std::ops::RangeInclusive<f64> = 0.5..=160.0;
/// Share of the observations that may lie behind their cameras.
const BEHIND: f64 = 0.2;
/// Mean reprojection error from which on intrinsics and images do not belong together, pixels.
const ERROR_PX: f64 = 4.0;
/// Names that are listed where a file is missing.
const LISTED: usize = 1000;

pub fn of_model(visit: &Visit) -> Vec<Finding> {
    [units, wanted, cameras, behind, residuals].iter().filter_map(|check| check(visit)).collect()
}

pub fn of_images(visit: &Visit) -> Vec<Finding> {
    [sizes, missing].iter().filter_map(|check| check(visit)).collect()
}

/// The settings say metres.
fn units(visit: &Visit) -> Option<Finding> {
    let gsd = visit.scene.median_gsd()?;
    let wrong = visit.settings.units == Some(Units::Metric) && !METRIC_GSD.contains(&gsd);
    wrong.then(|| {
        let what = format!("units = \"metric\" cannot be true: a pixel would be {gsd:.3e} m on the ground");
        let cure = "take units = \"metric\" out of viewrank.toml, or scale the model (colmap model_aligner)";
        Finding::new(Severity::Error, "impossible-units", what, cure)
    })
}

/// What is wanted against what the images have.
fn wanted(visit: &Visit) -> Option<Finding> {
    let (gsd, target) = (visit.scene.median_gsd()?, visit.settings.target.gsd?);
    let ratio = target / (gsd / visit.settings.image_scale);
    (!(1.0 / WANTED_RATIO..=WANTED_RATIO).contains(&ratio)).then(|| {
        let than =
            if ratio < 1.0 { format!("{:.0} times finer", 1.0 / ratio) } else { format!("{ratio:.0} times coarser") };
        let what = format!(
            "the wanted ground sampling distance, {target}, is {than} than the images' own, {gsd:.3e} units per pixel"
        );
        let cure = "give --gsd and target.accuracy in units of the model; viewrank inspect says its median";
        Finding::new(Severity::Warning, "impossible-target", what, cure)
    })
}

/// Intrinsics that no camera has.
fn cameras(visit: &Visit) -> Option<Finding> {
    let wrong = |view: &ViewIndex| {
        let camera = visit.scene.camera_of(*view);
        let (f, c) = camera.pinhole_part();
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let field = 2.0 * (0.5 * width / f.x).atan().to_degrees();
        let middle = (0.0..=width).contains(&c.x) && (0.0..=height).contains(&c.y);
        let fits = !camera.is_pinhole() || FIELD.contains(&field) && (0.2..=5.0).contains(&(f.y / f.x));
        !(fits && middle)
    };
    let views: Vec<ViewIndex> = visit.scene.view_indices().filter(wrong).collect();
    let camera = visit.scene.camera_of(*views.first()?);
    let (f, c) = camera.pinhole_part();
    let what = format!(
        "camera {} cannot be true: focal lengths {:.1}, {:.1} px and principal point {:.1}, {:.1} px in an image of {} x {} px",
        camera.id, f.x, f.y, c.x, c.y, camera.width, camera.height
    );
    let cure = "focal lengths and principal points are in pixels of the images: correct the cameras and adjust the model again";
    Some(Finding::new(Severity::Error, "impossible-camera", what, cure).of_views(named(visit, views)))
}

/// Points behind the cameras that observe them: poses the wrong way round.
fn behind(visit: &Visit) -> Option<Finding> {
    let scene = visit.scene;
    let share = |view: ViewIndex| {
        let (pose, points) = (&scene.view(view).cam_from_world, visit.points.of(view));
        let behind = points.iter().filter(|p| pose.camera_from_world(&scene.points[p.at()]).z <= 0.0).count();
        behind as f64 / points.len().max(1) as f64
    };
    let views: Vec<ViewIndex> = scene.view_indices().filter(|&view| share(view) > BEHIND).collect();
    (!views.is_empty()).then(|| {
        let with = counted(views.len(), "view");
        let what = format!("{with} with many points behind the camera: these poses cannot be true");
        let many = 2 * views.len() > scene.views.len();
        let severity = if many { Severity::Error } else { Severity::Warning };
        let cure = "poses are from the world to the camera, which looks along +z with y down: look at how the model was converted";
        Finding::new(severity, "points-behind-cameras", what, cure).of_views(named(visit, views))
    })
}

/// Cameras, poses and points that do not belong together.
fn residuals(visit: &Visit) -> Option<Finding> {
    let scene = visit.scene;
    let of_point = |p: u32| {
        let point = PointIndex(p);
        scene.track(point).filter_map(move |o| scene.reprojection_error(point, o))
    };
    let mut errors: Vec<f64> = (0..scene.points.len() as u32).flat_map(of_point).collect();
    if errors.is_empty() {
        return None;
    }
    let middle = errors.len() / 2;
    let median = *errors.select_nth_unstable_by(middle, f64::total_cmp).1;
    (median > ERROR_PX).then(|| {
        let what = format!(
            "the median reprojection error is {median:.1} px: cameras, poses and observations do not belong together"
        );
        let cure =
            "adjust the model again (colmap bundle_adjuster), and see that intrinsics are of images of this size";
        Finding::new(Severity::Error, "large-reprojection-error", what, cure)
    })
}

/// Images of another size than the model says.
fn sizes(visit: &Visit) -> Option<Finding> {
    let &(first, [width, height]) = visit.images.other_size.first()?;
    let camera = visit.scene.camera_of(first);
    let what = format!(
        "{} is {width} x {height} px, and the model says {} x {}: these are not the images of the model",
        visit.scene.name(first),
        camera.width,
        camera.height
    );
    let cure = "give the images that the model was made of, or those of the undistorted workspace with its own model";
    let views = visit.images.other_size.iter().map(|(view, _)| *view).collect();
    Some(Finding::new(Severity::Error, "images-of-another-size", what, cure).of_views(named(visit, views)))
}

/// Views without their files.
fn missing(visit: &Visit) -> Option<Finding> {
    let (images, views) = (visit.project.images.as_ref()?, &visit.images.missing);
    (!views.is_empty()).then(|| {
        let what = format!("{} of {} images are not in {}", views.len(), visit.scene.views.len(), images.display());
        let listed = views.iter().copied().take(LISTED).collect();
        let cure = format!("copy them there under the names of the model: {}/NAME", images.display());
        Finding::new(Severity::Warning, "missing-images", what, cure).of_views(named(visit, listed))
    })
}

fn named(visit: &Visit, views: Vec<ViewIndex>) -> Vec<(String, String)> {
    views.into_iter().map(|view| (visit.name(view), String::new())).collect()
}
