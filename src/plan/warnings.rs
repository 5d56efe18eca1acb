//! What the user should know of a plan before relying on it.

use super::{Finished, Stages};
use crate::method::ranking::Ranking;
use crate::{
    config::{ConfidenceForm, Settings, SurfaceChoice},
    method::{confidence::Confidence, surface::SurfaceKind},
    model::scene::Scene,
};

/// Share of the observations of a table that may contradict it.
const CONTRADICTIONS: f64 = 0.05;
/// The wanted ground sampling distance is not so many times another than the images'.
const WANTED_RATIO: f64 = 20.0;
/// Share of what is wanted that all clusters together give, below which the plan says so.
const LITTLE: f64 = 0.5;
/// Eastings of UTM coordinates, metres; a zone is no wider.
const EASTINGS: std::ops::Range<f64> = 100_000.0..900_000.0;
/// Depth maps that are named.
const NAMED: usize = 3;

pub(super) fn warnings(stages: &Stages, ranking: &Ranking, finished: &Finished) -> Vec<String> {
    let mut warnings: Vec<String> = stages.scene.warnings.iter().map(|warning| warning.text.clone()).collect();
    warnings.extend(stages.pictures.warnings.iter().cloned());
    warnings.extend(unlikely_gsd(&stages.scene, &stages.settings));
    warnings.extend(no_utm_coordinates(stages));
    warnings.extend(no_3d_surface(stages));
    warnings.extend(unlike_pictures(stages));
    warnings.extend(other_backend(stages));
    warnings.extend(without_effect(stages));
    warnings.extend(single_partner(stages));
    warnings.extend(little_fulfilled(ranking));
    warnings.extend(contradictions(stages));
    warnings.extend(outdated(stages, finished));
    warnings.extend(finished.unreadable.iter().cloned());
    warnings.extend(tiled(stages));
    warnings
}

/// A wanted ground sampling distance that is far from the images' own: another unit, most likely.
pub fn unlikely_gsd(scene: &Scene, settings: &Settings) -> Option<String> {
    let (gsd, target) = (scene.median_gsd()?, settings.target.gsd?);
    let ratio = target / (gsd / settings.image_scale);
    let than = match ratio {
        ratio if ratio < 1.0 / WANTED_RATIO => format!("{:.0} times finer", 1.0 / ratio),
        ratio if ratio > WANTED_RATIO => format!("{ratio:.0} times coarser"),
        _ => return None,
    };
    Some(format!(
        "the wanted ground sampling distance, {target}, is {than} than the images' own, {gsd:.3e} units per pixel; it is in units of the model"
    ))
}

/// A model that is to be in UTM coordinates, and lies where no zone has its eastings.
fn no_utm_coordinates(stages: &Stages) -> Option<String> {
    let frame = &stages.settings.frame;
    let zone = frame.utm.as_ref()?;
    let easting = stages.scene.points.first()?.x + frame.offset.unwrap_or_default()[0];
    (!EASTINGS.contains(&easting)).then(|| {
        format!(
            "frame.utm is {zone}, but a point of the model has an easting of {easting:.0} m, which no zone has: what is to be added to x \
             and y is frame.offset"
        )
    })
}

/// A surface that was to be carved, of points that enclose nothing.
fn no_3d_surface(stages: &Stages) -> Option<String> {
    let settings = &stages.settings.surface;
    let other = settings.mesh.is_none()
        && settings.kind == SurfaceChoice::Carved
        && stages.surface.kind == SurfaceKind::Terrain;
    other.then(|| "the sparse points lie in a plane: the surface is a terrain, though a 3D one was asked for".into())
}

/// Finished depth maps that have to be made again.
fn outdated(stages: &Stages, finished: &Finished) -> Option<String> {
    let outdated = &finished.outdated;
    let names: Vec<&str> = outdated.iter().take(NAMED).map(|o| o.key.as_str()).collect();
    let more = if outdated.len() > NAMED { ", ..." } else { "" };
    (!outdated.is_empty()).then(|| {
        format!(
            "{} finished depth maps no longer fit the model, whose views moved by more than {} px: {}{more}; remove them so that \
             the backend makes them again",
            outdated.len(),
            stages.settings.ranking.keep_px,
            names.join(", ")
        )
    })
}

/// Pictures that the model has not seen the like of.
fn unlike_pictures(stages: &Stages) -> Option<String> {
    let distance = stages.pictures.distance.filter(|&distance| distance > 1.0 && stages.trained.is_some())?;
    Some(format!(
        "the pictures are unlike those that the confidence was trained on ({distance:.1} times as far as those are from each other): \
         compute some depth maps and train on them (viewrank train), or take --confidence geometric"
    ))
}

/// A model that learnt from another program's depth maps.
fn other_backend(stages: &Stages) -> Option<String> {
    let trained = stages.trained.as_ref().filter(|trained| trained.backend != stages.backend)?;
    Some(format!("the confidence was trained on depth maps of {}, the plan is for {}", trained.backend, stages.backend))
}

/// Settings of confidence that what predicts success here does not heed.
fn without_effect(stages: &Stages) -> Option<String> {
    let set = &stages.settings.confidence;
    let pair = matches!(stages.confidence, Confidence::Pair(_) | Confidence::Photometric { .. });
    let paper = matches!(stages.confidence, Confidence::Paper { .. });
    let unheeded = [
        ("form", set.form == ConfidenceForm::Paper && !paper),
        ("p0", set.p0.is_some() && !pair),
        ("cosine_power", set.cosine_power.is_some() && !pair),
        ("scale_octaves", set.scale_octaves.is_some() && !pair),
        ("full_angle", set.full_angle.is_some() && !pair),
        ("min_matches", set.min_matches.is_some() && stages.confidence == Confidence::None),
    ];
    let names: Vec<String> =
        unheeded.into_iter().filter(|(_, is)| *is).map(|(name, _)| format!("confidence.{name}")).collect();
    let source = &set.source;
    (!names.is_empty()).then(|| format!("set, but without effect where confidence is {source}: {}", names.join(", ")))
}

/// Fewer cameras than the method wants to see a place.
fn single_partner(stages: &Stages) -> Option<String> {
    (stages.settings.partners.k == 1)
        .then(|| "with k = 1 a place counts where two cameras see it; no third one confirms what they match".into())
}

/// The shares of the plan are of what all clusters reach together, which may be next to nothing.
fn little_fulfilled(ranking: &Ranking) -> Option<String> {
    let given = ranking.total_kept();
    (!ranking.order.is_empty() && given < LITTLE).then(|| {
        format!(
            "all images together can give only {:.0} % of what is wanted, and shares are of that: surface.ply has the reason of each triangle; \
             more partners (-k) or a coarser --gsd may give more",
            100.0 * given
        )
    })
}

fn contradictions(stages: &Stages) -> Option<String> {
    let share = stages.visibility.contradictions as f64 / stages.scene.observations().max(1) as f64;
    (share > CONTRADICTIONS).then(|| {
        format!(
            "{:.0} % of the observations contradict the surface: views observe points that it hides from them; \
             a better surface can be given with --mesh",
            share * 100.0
        )
    })
}

fn tiled(stages: &Stages) -> Option<String> {
    let tiles = stages.surface_stats.tiles;
    (tiles > 1).then(|| {
        format!(
            "the surface was built in {tiles} tiles of at most {} points; where they meet its triangles are not those of a whole surface",
            stages.settings.surface.tile_points.unwrap_or_default()
        )
    })
}
