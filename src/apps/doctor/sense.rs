//! Implausible numbers: units, cameras, poses, image sizes.

use std::ops::RangeInclusive;

use super::{Finding, Inputs, MOST, Severity, counted};
use crate::{
    base::{advice::on_command_line, error::Advice, median::upper_median},
    io::project::Turned,
    model::{
        georeference::{Georeference, MapFrame, UPRIGHT},
        scene::{PointIndex, Units, ViewIndex, WarningKind},
    },
    plan,
};

/// Usual ground sampling distances, metres: from a turntable to a high flight.
const USUAL_GSD: RangeInclusive<f64> = 1e-4..=5.0;
/// Possible ground sampling distances, metres: from a microscope to a satellite.
const POSSIBLE_GSD: RangeInclusive<f64> = 1e-6..=100.0;
/// UTM coordinates of any place on land, metres.
const EASTINGS: RangeInclusive<f64> = 1e5..=9e5;
const NORTHINGS: RangeInclusive<f64> = 0.0..=1e7;
/// Horizontal field of view of any camera, degrees.
const FIELD: RangeInclusive<f64> = 0.5..=160.0;
/// Largest share of a view's points behind the camera that is not reported.
const BEHIND: f64 = 0.2;
/// Median reprojection error, pixels, above which intrinsics and images do not match.
const ERROR_PX: f64 = 4.0;

pub fn of_model(inputs: &Inputs) -> Vec<Finding> {
    [points, units, frame, wanted, cameras, behind, residuals]
        .iter()
        .filter_map(|check| check(inputs))
        .collect()
}

pub fn of_images(inputs: &Inputs) -> Vec<Finding> {
    [scaled, foreign, missing, unreadable]
        .iter()
        .filter_map(|check| check(inputs))
        .collect()
}

/// Reports a model in which no point is seen by two views: the surface is built from such points
/// (method 1.1).
fn points(inputs: &Inputs) -> Option<Finding> {
    let mut tracks =
        (0..inputs.scene.points.len() as u32).map(|p| inputs.scene.track_views(PointIndex(p)));
    // The views of a track ascend: both ends are one view only if all are.
    let is_shared = tracks.any(|views| views.first() != views.last());
    // A model without any is a finding of its own, with the remedy for its format.
    let warnings = &inputs.scene.warnings;
    let has_none = warnings.iter().any(|w| w.kind == WarningKind::NoPoints);
    (!is_shared && !has_none).then(|| {
        let what = "no sparse point is seen by two views: surface, overlap and scale are unknown";
        let cure =
            "triangulate points (colmap point_triangulator), or give the model that has them";
        Finding::new(Severity::Error, "no-common-points", what, cure)
    })
}

/// Checks the ground sampling distance if the settings give metres as the unit or georeference the
/// model.
fn units(inputs: &Inputs) -> Option<Finding> {
    let claim = match plan::georeference(inputs.project, inputs.scene, &inputs.settings.frame) {
        _ if inputs.settings.units == Some(Units::Metric) => "units = \"metric\"",
        Georeference::EastNorthUp { .. } | Georeference::Utm { .. } => "a georeference in metres",
        Georeference::Local | Georeference::Ecef | Georeference::Fitted { .. } => return None,
    };
    let gsd = inputs.scene.median_gsd()?;
    let (severity, verdict) = match gsd {
        gsd if USUAL_GSD.contains(&gsd) => return None,
        gsd if POSSIBLE_GSD.contains(&gsd) => (Severity::Warning, "is implausible"),
        _ => (Severity::Error, "is impossible"),
    };
    let what = format!("{claim} {verdict}: a pixel would measure {gsd:.3e} m on the ground");
    let cure = "remove units = \"metric\" and [frame] from viewrank.toml, or scale the model (colmap model_aligner)";
    Some(Finding::new(severity, "impossible-units", what, cure))
}

/// Checks the georeference given by the settings or by the program that made the model.
fn frame(inputs: &Inputs) -> Option<Finding> {
    let place = plan::georeference(inputs.project, inputs.scene, &inputs.settings.frame);
    if matches!(
        place,
        Georeference::EastNorthUp { .. } | Georeference::Utm { .. }
    ) {
        let up = MapFrame::new(inputs.scene, inputs.settings.surface.up).axes[2];
        if up.z < UPRIGHT {
            // Rounding may leave a unit vector beyond -1, whose angle would not be a number.
            let angle = up.z.clamp(-1.0, 1.0).acos().to_degrees();
            let what = format!(
                "the georeference has the model's third axis up, but the cameras' up is {angle:.0} degrees off: views.geojson shows the model \
                 on its side"
            );
            let cure =
                "rotate the model (colmap model_aligner), or remove [frame] from viewrank.toml";
            return Some(Finding::new(
                Severity::Warning,
                "impossible-frame",
                what,
                cure,
            ));
        }
    }
    let Georeference::Utm { offset, .. } = place else {
        return None;
    };
    let centres = || {
        inputs
            .scene
            .views
            .iter()
            .map(|view| view.cam_from_world.centre())
    };
    let at = |x: f64, y: f64| (x + offset[0], y + offset[1]);
    let inside = |(easting, northing): (f64, f64)| {
        EASTINGS.contains(&easting) && NORTHINGS.contains(&northing)
    };
    let outside = centres()
        .map(|c| at(c.x, c.y))
        .find(|&place| !inside(place))?;
    let what = format!(
        "these are not UTM coordinates: views.geojson shows a camera at easting {:.0}, northing {:.0}",
        outside.0, outside.1
    );
    let cure = "set frame.offset in viewrank.toml to what must be added to the model's coordinates, or set frame.origin";
    Some(Finding::new(
        Severity::Warning,
        "impossible-frame",
        what,
        cure,
    ))
}

/// Compares the wanted ground sampling distance with that of the images.
fn wanted(inputs: &Inputs) -> Option<Finding> {
    let frame = &inputs.settings.frame;
    let place = plan::georeference(inputs.project, inputs.scene, frame);
    let metres = plan::metres(inputs.settings.units, &place);
    let what = plan::unlikely_gsd(inputs.scene.median_gsd(), inputs.settings, metres)?;
    let cure = Advice::text("look at the median that ")
        .run("inspect")
        .and(" shows, and correct ")
        .set("target.gsd")
        .and(" and target.accuracy");
    let cure = on_command_line(&cure);
    Some(Finding::new(
        Severity::Warning,
        "impossible-target",
        what,
        cure,
    ))
}

/// Reports intrinsics that no real camera could have.
fn cameras(inputs: &Inputs) -> Option<Finding> {
    let wrong = |view: &ViewIndex| {
        let camera = inputs.scene.camera_of(*view);
        let (f, c) = camera.pinhole_part();
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let field = 2.0 * (0.5 * width / f.x).atan().to_degrees();
        let is_centred = (0.0..=width).contains(&c.x) && (0.0..=height).contains(&c.y);
        // A lens with distortion may have any field, which its focal length alone does not give.
        let fits =
            !camera.is_pinhole() || FIELD.contains(&field) && (0.2..=5.0).contains(&(f.y / f.x));
        !(fits && is_centred)
    };
    let views: Vec<ViewIndex> = inputs.scene.view_indices().filter(wrong).collect();
    let camera = inputs.scene.camera_of(*views.first()?);
    let (f, c) = camera.pinhole_part();
    // A number of 300 digits would hide the rest.
    let px = |x: f64| {
        if x.abs() < 1e7 {
            format!("{x:.1}")
        } else {
            format!("{x:.1e}")
        }
    };
    let what = format!(
        "camera {} is impossible: focal lengths {}, {} px and principal point {}, {} px in an image of {} x {} px",
        camera.id,
        px(f.x),
        px(f.y),
        px(c.x),
        px(c.y),
        camera.width,
        camera.height
    );
    let cure = "correct the cameras (in pixels of the images) and run bundle adjustment again";
    Some(
        Finding::new(Severity::Error, "impossible-camera", what, cure)
            .of_views(inputs.named(views)),
    )
}

/// Reports views with points behind the camera, a sign of inverted poses.
fn behind(inputs: &Inputs) -> Option<Finding> {
    let scene = inputs.scene;
    let share = |view: ViewIndex| {
        let (pose, points) = (
            &scene.view(view).cam_from_world,
            inputs.points.observed_by(view),
        );
        let camera = scene.camera_of(view);
        let is_behind = |p: &&PointIndex| {
            camera.depth(&pose.camera_from_world(&scene.points[p.index()])) <= 0.0
        };
        let behind = points.iter().filter(is_behind).count();
        behind as f64 / points.len().max(1) as f64
    };
    let views: Vec<ViewIndex> = scene
        .view_indices()
        .filter(|&view| share(view) > BEHIND)
        .collect();
    (!views.is_empty()).then(|| {
        let with = counted(views.len(), "view");
        let what = format!("{with} with many points behind the camera: these poses are wrong");
        let is_majority = 2 * views.len() > scene.views.len();
        let severity = if is_majority { Severity::Error } else { Severity::Warning };
        let cure = "check how the model was converted: poses must map world to camera, with +z forward and y down";
        Finding::new(severity, "points-behind-cameras", what, cure).of_views(inputs.named(views))
    })
}

/// Reports large reprojection errors: as an error if most views have them, else as a warning.
fn residuals(inputs: &Inputs) -> Option<Finding> {
    let scene = inputs.scene;
    let mut of_view: Vec<Vec<f64>> = vec![Vec::new(); scene.views.len()];
    for point in (0..scene.points.len() as u32).map(PointIndex) {
        for observation in scene.track(point) {
            let error = scene.reprojection_error(point, observation);
            of_view[scene.track_views[observation].index()].extend(error);
        }
    }
    let medians: Vec<Option<f64>> = of_view.into_iter().map(upper_median).collect();
    let wrong = |view: &ViewIndex| medians[view.index()].is_some_and(|error| error > ERROR_PX);
    let views: Vec<ViewIndex> = scene.view_indices().filter(wrong).collect();
    let known = medians.iter().flatten().count();
    let (severity, cure) = if 2 * views.len() > known {
        (
            Severity::Error,
            "run bundle adjustment again (colmap bundle_adjuster); check that the intrinsics are for images of this size",
        )
    } else {
        (
            Severity::Warning,
            "run bundle adjustment again (colmap bundle_adjuster), or remove these views (colmap image_deleter)",
        )
    };
    (!views.is_empty()).then(|| {
        let what = format!(
            "{} with a median reprojection error above {ERROR_PX} px: camera, pose and observations do not match",
            counted(views.len(), "view")
        );
        let words = views
            .iter()
            .map(|&view| inputs.view_finding(view, format!("{:.1} px", medians[view.index()].unwrap_or(0.0))));
        Finding::new(severity, "large-reprojection-error", what, cure).of_views(words.collect())
    })
}

/// Reports images that are scaled copies of the model's.
fn scaled(inputs: &Inputs) -> Option<Finding> {
    let (kind, images) = (
        (Severity::Warning, "scaled-images"),
        &inputs.images.other_size,
    );
    let is_larger = images
        .first()
        .is_some_and(|(view, [width, _])| *width > inputs.scene.camera_of(*view).width);
    let what = if is_larger {
        "some programs stop at images of another size"
    } else {
        "scaled copies have less detail than is planned for, and some programs stop at them"
    };
    let cure =
        "give the images that the model was made from, or a model with cameras of their size";
    of_another_size(inputs, kind, images, what, cure)
}

/// Reports images whose aspect ratio differs from the model's.
fn foreign(inputs: &Inputs) -> Option<Finding> {
    let (kind, images) = (
        (Severity::Error, "images-of-another-size"),
        &inputs.images.other_aspect_ratio,
    );
    let turned = inputs.images.turned;
    let what = turned.map_or("these are not the model's images", Turned::why);
    let cure = inputs.images.cure().unwrap_or_default();
    of_another_size(inputs, kind, images, what, cure)
}

/// Reports these images with the sizes of the first.
fn of_another_size(
    inputs: &Inputs,
    (severity, check): (Severity, &'static str),
    images: &[(ViewIndex, [u32; 2])],
    what: &str,
    cure: &str,
) -> Option<Finding> {
    let &(first, [width, height]) = images.first()?;
    let (name, camera) = (inputs.scene.name(first), inputs.scene.camera_of(first));
    let (of_image, of_model) = (
        format!("{width} x {height} px"),
        format!("{} x {} px", camera.width, camera.height),
    );
    let what = format!("{name} is {of_image}, but {of_model} in the model: {what}");
    let views = inputs.named(images.iter().map(|(view, _)| *view));
    Some(Finding::new(severity, check, what, cure).of_views(views))
}

/// Severity of missing and unreadable images, which together may be most.
fn severity(inputs: &Inputs) -> Severity {
    let without = inputs.images.missing.len() + inputs.images.unreadable.len();
    if without as f64 >= MOST * inputs.scene.views.len() as f64 {
        Severity::Error
    } else {
        Severity::Warning
    }
}

/// Reports views without image files.
fn missing(inputs: &Inputs) -> Option<Finding> {
    let (images, views) = (inputs.project.images.as_ref()?, &inputs.images.missing);
    (!views.is_empty()).then(|| {
        let what = format!(
            "{} of {} images are not in {}",
            views.len(),
            inputs.scene.views.len(),
            images.display()
        );
        let candidates = |view| images.candidates_for(inputs.scene.name(view));
        let of_two = if views.iter().any(|&view| candidates(view).is_some()) {
            "; where two files fit a name, move one of them out of the folder"
        } else {
            ""
        };
        let cure = format!(
            "copy them to {}/NAME, with the names in the model{of_two}",
            images.display()
        );
        let of_view = |&view: &ViewIndex| match candidates(view) {
            Some([one, other]) => inputs.view_finding(view, format!("{one} or {other}?")),
            None => inputs.view_finding(view, ""),
        };
        Finding::new(severity(inputs), "missing-images", what, cure)
            .of_views(views.iter().map(of_view).collect())
    })
}

/// Reports views whose image files cannot be read.
fn unreadable(inputs: &Inputs) -> Option<Finding> {
    let broken = &inputs.images.unreadable;
    (!broken.is_empty()).then(|| {
        let what = format!("{} cannot be read", counted(broken.len(), "image"));
        let cure = inputs.images.cure().unwrap_or_default();
        let views = broken
            .iter()
            .map(|&(view, why)| inputs.view_finding(view, why))
            .collect();
        Finding::new(severity(inputs), "unreadable-images", what, cure).of_views(views)
    })
}
