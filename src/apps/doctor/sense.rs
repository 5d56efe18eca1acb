//! Numbers that can't be true: units, cameras, poses, images of another size.

use std::ops::RangeInclusive;

use super::{Finding, Severity, Visit, counted};
use crate::plan;
use crate::{
    method::surface::points::upper_median,
    model::{
        georeference::{Georeference, MapFrame, UPRIGHT},
        scene::{PointIndex, Units, ViewIndex},
    },
    plan::unlikely_gsd,
};

/// Ground sampling distances of surveys, metres: from a turntable to a high flight.
const USUAL_GSD: RangeInclusive<f64> = 1e-4..=5.0;
/// Those of any survey: from a microscope to a satellite.
const POSSIBLE_GSD: RangeInclusive<f64> = 1e-6..=100.0;
/// UTM coordinates of any place on land, metres.
const EASTINGS: RangeInclusive<f64> = 1e5..=9e5;
const NORTHINGS: RangeInclusive<f64> = 0.0..=1e7;
/// Fields of view of any camera, degrees.
const FIELD: RangeInclusive<f64> = 0.5..=160.0;
/// Share of the observations that may lie behind their cameras.
const BEHIND: f64 = 0.2;
/// Median reprojection error from which on intrinsics and images do not belong together, pixels.
const ERROR_PX: f64 = 4.0;

pub fn of_model(visit: &Visit) -> Vec<Finding> {
    [points, units, frame, wanted, cameras, behind, residuals].iter().filter_map(|check| check(visit)).collect()
}

pub fn of_images(visit: &Visit) -> Vec<Finding> {
    [sizes, missing, unreadable].iter().filter_map(|check| check(visit)).collect()
}

/// Without points that two views see nothing is known of the surface (method 1.1).
fn points(visit: &Visit) -> Option<Finding> {
    let mut tracks = (0..visit.scene.points.len() as u32).map(|p| visit.scene.track_views(PointIndex(p)));
    let none = !tracks.any(|views| views.first() != views.last());
    none.then(|| {
        let what = "no sparse point is seen by two views: no surface, no overlap and no scale is known, nothing can be planned";
        let cure = "triangulate points with the program that made the model (colmap point_triangulator), or give the model that has them";
        Finding::new(Severity::Error, "no-common-points", what, cure)
    })
}

/// The settings say metres, or where the model lies on the earth.
fn units(visit: &Visit) -> Option<Finding> {
    let said = match plan::georeference(visit.project, visit.scene, &visit.settings.frame) {
        _ if visit.settings.units == Some(Units::Metric) => "units = \"metric\"",
        Georeference::EastNorthUp { .. } | Georeference::Utm { .. } => "a place on the earth, and so metres,",
        Georeference::Local | Georeference::Ecef => return None,
    };
    let gsd = visit.scene.median_gsd()?;
    let (severity, verdict) = match gsd {
        gsd if USUAL_GSD.contains(&gsd) => return None,
        gsd if POSSIBLE_GSD.contains(&gsd) => (Severity::Warning, "is unlikely to be"),
        _ => (Severity::Error, "cannot be"),
    };
    let what = format!("{said} {verdict} true: a pixel would be {gsd:.3e} m on the ground");
    let cure = "take units = \"metric\" and [frame] out of viewrank.toml, or scale the model (colmap model_aligner)";
    Some(Finding::new(severity, "impossible-units", what, cure))
}

/// The settings, or the program that made the model, say where on the earth it lies.
fn frame(visit: &Visit) -> Option<Finding> {
    let place = plan::georeference(visit.project, visit.scene, &visit.settings.frame);
    if matches!(place, Georeference::EastNorthUp { .. } | Georeference::Utm { .. }) {
        let up = MapFrame::new(visit.scene, visit.settings.surface.up).axes[2];
        if up.z < UPRIGHT {
            let angle = up.z.clamp(-1.0, 1.0).acos().to_degrees();
            let what = format!(
                "the model is said to lie on the earth with its third axis up, but by its cameras up is {angle:.0} degrees away \
                 from that: views.geojson shows it lying on its side"
            );
            let cure = "turn the model (colmap model_aligner), or take [frame] out of viewrank.toml";
            return Some(Finding::new(Severity::Warning, "impossible-frame", what, cure));
        }
    }
    let Georeference::Utm { offset, .. } = place else { return None };
    let centres = || visit.scene.views.iter().map(|view| view.cam_from_world.centre());
    let at = |x: f64, y: f64| (x + offset[0], y + offset[1]);
    let inside = |(easting, northing): (f64, f64)| EASTINGS.contains(&easting) && NORTHINGS.contains(&northing);
    let outside = centres().map(|c| at(c.x, c.y)).find(|&place| !inside(place))?;
    let what = format!(
        "these are no UTM coordinates: a camera would be at easting {:.0}, northing {:.0}, and views.geojson shows it there",
        outside.0, outside.1
    );
    let cure = "say in viewrank.toml what is to be added to the model's coordinates (frame.offset), or its origin (frame.origin)";
    Some(Finding::new(Severity::Warning, "impossible-frame", what, cure))
}

/// What is wanted against what the images have.
fn wanted(visit: &Visit) -> Option<Finding> {
    let what = unlikely_gsd(visit.scene, visit.settings)?;
    let cure = "give --gsd and target.accuracy in units of the model; viewrank inspect says its median";
    Some(Finding::new(Severity::Warning, "impossible-target", what, cure))
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
    Some(Finding::new(Severity::Error, "impossible-camera", what, cure).of_views(visit.named(views)))
}

/// Points behind the cameras that observe them: poses the wrong way round.
fn behind(visit: &Visit) -> Option<Finding> {
    let scene = visit.scene;
    let share = |view: ViewIndex| {
        let (pose, points) = (&scene.view(view).cam_from_world, visit.points.observed_by(view));
        let camera = scene.camera_of(view);
        let is_behind = |p: &&PointIndex| camera.depth(&pose.camera_from_world(&scene.points[p.index()])) <= 0.0;
        let behind = points.iter().filter(is_behind).count();
        behind as f64 / points.len().max(1) as f64
    };
    let views: Vec<ViewIndex> = scene.view_indices().filter(|&view| share(view) > BEHIND).collect();
    (!views.is_empty()).then(|| {
        let with = counted(views.len(), "view");
        let what = format!("{with} with many points behind the camera: these poses cannot be true");
        let many = 2 * views.len() > scene.views.len();
        let severity = if many { Severity::Error } else { Severity::Warning };
        let cure = "poses are from the world to the camera, which looks along +z with y down: look at how the model was converted";
        Finding::new(severity, "points-behind-cameras", what, cure).of_views(visit.named(views))
    })
}

/// Cameras, poses and points that do not belong together: everywhere, or in some views.
fn residuals(visit: &Visit) -> Option<Finding> {
    let scene = visit.scene;
    let mut of_view: Vec<Vec<f64>> = vec![Vec::new(); scene.views.len()];
    for point in (0..scene.points.len() as u32).map(PointIndex) {
        for observation in scene.track(point) {
            let error = scene.reprojection_error(point, observation);
            of_view[scene.track_views[observation].index()].extend(error);
        }
    }
    let medians: Vec<Option<f64>> = of_view.into_iter().map(|errors| upper_median(errors.into_iter())).collect();
    let wrong = |view: &ViewIndex| medians[view.index()].is_some_and(|error| error > ERROR_PX);
    let views: Vec<ViewIndex> = scene.view_indices().filter(wrong).collect();
    let known = medians.iter().flatten().count();
    let (severity, cure) = match 2 * views.len() > known {
        true => (
            Severity::Error,
            "adjust the model again (colmap bundle_adjuster), and see that intrinsics are of images of this size",
        ),
        false => (
            Severity::Warning,
            "adjust the model again (colmap bundle_adjuster), or take these views out (colmap image_deleter)",
        ),
    };
    (!views.is_empty()).then(|| {
        let what = format!(
            "{} with a reprojection error of more than {ERROR_PX} px in the median: camera, pose and observations do not belong together",
            counted(views.len(), "view")
        );
        let words = views.iter().map(|&view| visit.of(view, format!("{:.1} px", medians[view.index()].unwrap_or(0.0))));
        Finding::new(severity, "large-reprojection-error", what, cure).of_views(words.collect())
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
    let views = visit.images.other_size.iter().map(|(view, _)| *view);
    Some(Finding::new(Severity::Error, "images-of-another-size", what, cure).of_views(visit.named(views)))
}

/// Views without their files.
fn missing(visit: &Visit) -> Option<Finding> {
    let (images, views) = (visit.project.images.as_ref()?, &visit.images.missing);
    (!views.is_empty()).then(|| {
        let what = format!("{} of {} images are not in {}", views.len(), visit.scene.views.len(), images.display());
        let cure = format!("copy them there under the names of the model: {}/NAME", images.display());
        Finding::new(Severity::Warning, "missing-images", what, cure).of_views(visit.named(views.iter().copied()))
    })
}

/// Views whose files cannot be read.
fn unreadable(visit: &Visit) -> Option<Finding> {
    let broken = &visit.images.unreadable;
    (!broken.is_empty()).then(|| {
        let what = format!("{} cannot be read", counted(broken.len(), "image"));
        let cure = "copy them again from where they came";
        let views = broken.iter().map(|&(view, why)| visit.of(view, why)).collect();
        Finding::new(Severity::Warning, "unreadable-images", what, cure).of_views(views)
    })
}
