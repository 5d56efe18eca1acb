//! Warnings that the user should read before relying on a plan.

use std::borrow::Cow;

use super::{Band, Cut, Decision, FinishedMaps, GroundSummary, Stages};
use crate::method::ranking::Ranking;
use crate::{
    base::{
        advice::on_command_line,
        decimals::significant,
        error::{Advice, shortened},
    },
    config::{Budget, Settings, Share, SurfaceChoice},
    decision::DEFAULT_TARGET,
    method::confidence::{Confidence, Sharpness},
    model::surface::SurfaceKind,
};

/// Share of the observations of a table that may contradict it.
const CONTRADICTIONS: f64 = 0.05;
/// Ratio, either way, of the wanted to the images' own ground sampling distance beyond which the
/// unit is probably wrong.
const WANTED_RATIO: f64 = 20.0;
/// Share of what is wanted that all clusters together give, below which the plan says so.
const LITTLE: f64 = 0.4;
/// Width of the band of what all clusters give, over what they give, from which on the scene is one
/// that the confidence cannot judge: 0.9 to 1.2 in a room, around a bust and over a far oblique
/// view, 0.2 to 0.5 over flights.
const UNSURE: f64 = 0.7;
/// Eastings of UTM coordinates, metres; a zone is no wider.
const EASTINGS: std::ops::Range<f64> = 100_000.0..900_000.0;
/// One image in how many must be missing to be the first reason that little is reached.
const MISSING: usize = 10;
/// Depth maps that a warning names.
const NAMED: usize = 3;

pub fn warnings(stages: &Stages, decision: &Decision, finished: &FinishedMaps) -> Vec<String> {
    let Decision { ranking, cut, .. } = decision;
    let of_model = &stages.scene.warnings;
    let mut warnings: Vec<String> = of_model
        .iter()
        .map(|w| on_command_line(&w.describe()))
        .collect();
    warnings.extend(stages.picture_warnings.iter().cloned());
    warnings.extend(blurred(stages));
    warnings.extend(missed(stages));
    let metres = stages.metres;
    warnings.extend(unlikely_gsd(stages.image_gsd, &stages.settings, metres));
    warnings.extend(no_utm_coordinates(stages));
    warnings.extend(no_3d_surface(stages));
    warnings.extend(without_effect(stages));
    warnings.extend(one_size(stages));
    warnings.extend(unfit(stages));
    warnings.extend(single_partner(stages));
    if stages.makes_maps {
        let is_unsure = is_unsure(stages, ranking.reachable, &cut.reachable_band);
        let band = is_unsure.then_some(&cut.reachable_band);
        let little = little_fulfilled(ranking, band, lacks_images(stages));
        let has_said_so = little.is_some();
        warnings.extend(little);
        warnings.extend(unconfirmed(stages, cut));
        // The warning that little is reached has the band already.
        warnings.extend((is_unsure && !has_said_so).then(|| unsure(&cut.reachable_band)));
    }
    warnings.extend(more_than_all(stages));
    warnings.extend(no_number_of_images(stages));
    warnings.extend(unused_pilot(stages));
    warnings.extend(contradictions(stages));
    warnings.extend(outdated(stages, finished));
    let unreadable = &finished.unreadable;
    warnings.extend(unreadable.iter().take(NAMED).cloned());
    warnings.extend((unreadable.len() > NAMED).then(|| {
        let more = unreadable.len() - NAMED;
        let maps = if more == 1 { "map" } else { "maps" };
        format!("{more} more depth {maps} cannot be read")
    }));
    warnings.extend(tiled(stages));
    // Warnings quote names from the model, each of which may have megabytes.
    let short = warnings.iter().map(|warning| shortened(warning));
    short.map(Cow::into_owned).collect()
}

/// Warns of a region of which the photographs miss a part.
fn missed(stages: &Stages) -> Option<String> {
    let ground = stages
        .ground_summary()
        .filter(GroundSummary::is_incomplete)?;
    Some(ground.missed(stages.metres))
}

/// Warns of a wanted ground sampling distance far from the images' own (`image_gsd`), most likely
/// given in another unit, and says how to give it. `metres`: in a scene unit, if known.
pub fn unlikely_gsd(
    image_gsd: Option<f64>,
    settings: &Settings,
    metres: Option<f64>,
) -> Option<String> {
    let (gsd, target) = (image_gsd?, settings.target.gsd?);
    // Of the matched images, since the wanted GSD is of those too.
    let ratio = target / (gsd / settings.image_scale());
    let than = match ratio {
        ratio if ratio < 1.0 / WANTED_RATIO => format!("{:.0} times finer", 1.0 / ratio),
        ratio if ratio > WANTED_RATIO => format!("{ratio:.0} times coarser"),
        _ => return None,
    };
    let [target, gsd] = [target, gsd].map(|gsd| length_in_words(gsd, metres));
    let cure = match metres {
        Some(_) => "give it with its unit, as 2cm",
        None => "give it in units of the model",
    };
    Some(format!(
        "the wanted ground sampling distance ({target}) is {than} than the images' own ({gsd} per pixel); {cure}"
    ))
}

/// Formats a length of scene units. `metres`: in a scene unit, if known.
pub fn length_in_words(length: f64, metres: Option<f64>) -> String {
    match metres {
        Some(metres) => format!("{} m", significant(length * metres)),
        None => format!("{length:.3e} model units"),
    }
}

/// Warns of a model set to UTM whose eastings no zone has.
fn no_utm_coordinates(stages: &Stages) -> Option<String> {
    let frame = &stages.settings.frame;
    let zone = frame.utm.as_ref()?;
    let easting = stages.scene.points.first()?.x + frame.offset.unwrap_or_default()[0];
    (!EASTINGS.contains(&easting)).then(|| {
        format!(
            "frame.utm is {zone}, but a point of the model has an easting of {easting:.0} m, outside every zone; set frame.offset to what must be \
             added to x and y"
        )
    })
}

/// Warns of sizes that the backend cannot choose among.
fn one_size(stages: &Stages) -> Option<String> {
    stages.refused_half.then(|| {
        format!(
            "{} matches all key views at one size: ranking.scales counts as [1] (`viewrank backends NAME` says which programs match at two)",
            stages.backend
        )
    })
}

/// Warns of settings that mean nothing for the backend.
fn unfit(stages: &Stages) -> Option<String> {
    let makes = if stages.makes_maps {
        "makes depth maps"
    } else {
        "makes no depth maps"
    };
    (!stages.unfit.is_empty()).then(|| {
        format!(
            "{} {makes}: {} counts as not set",
            stages.backend,
            stages.unfit.join(", ")
        )
    })
}

/// Warns of a terrain built where a carved surface was asked for, because the points enclose no
/// volume.
fn no_3d_surface(stages: &Stages) -> Option<String> {
    let settings = &stages.settings.surface;
    let other = settings.mesh.is_none()
        && settings.kind == SurfaceChoice::Carved
        && stages.surface.kind == SurfaceKind::Terrain;
    other.then(|| {
        "the sparse points are coplanar: the surface is a terrain although surface.kind is 3d"
            .into()
    })
}

/// Warns of finished depth maps that must be computed again.
fn outdated(stages: &Stages, finished: &FinishedMaps) -> Option<String> {
    let outdated = &finished.outdated;
    let names: Vec<&str> = outdated
        .iter()
        .take(NAMED)
        .map(|o| o.key.as_str())
        .collect();
    let more = if outdated.len() > NAMED { ", ..." } else { "" };
    (!outdated.is_empty()).then(|| {
        format!(
            "{} finished depth maps no longer fit the model (their views moved by more than {} px): {}{more}; delete them to have them \
             computed again",
            outdated.len(),
            stages.settings.ranking.keep_px,
            names.join(", ")
        )
    })
}

/// Warns of confidence settings that the confidence source in force ignores.
fn without_effect(stages: &Stages) -> Option<String> {
    let set = &stages.settings.confidence;
    let pair = matches!(
        stages.rule.confidence,
        Confidence::Pair(_) | Confidence::Photometric { .. }
    );
    let photometric = matches!(stages.rule.confidence, Confidence::Photometric { .. });
    let ignored = [
        ("p0", set.p0.is_some() && !pair),
        ("cosine_power", set.cosine_power.is_some() && !pair),
        ("scale_octaves", set.scale_octaves.is_some() && !pair),
        ("full_angle", set.full_angle.is_some() && !pair),
        ("agree", set.agree.is_some() && !photometric),
        ("differ", set.differ.is_some() && !photometric),
        (
            "full_agreement",
            set.full_agreement.is_some() && !photometric,
        ),
        (
            "min_matches",
            set.min_matches.is_some() && stages.rule.confidence == Confidence::None,
        ),
    ];
    let names: Vec<String> = ignored
        .into_iter()
        .filter(|(_, is)| *is)
        .map(|(name, _)| format!("confidence.{name}"))
        .collect();
    let source = set.source;
    (!names.is_empty()).then(|| {
        format!(
            "confidence.source = {source} ignores {}; remove the setting",
            names.join(", ")
        )
    })
}

/// Warns of k = 1, which leaves out the third camera of the method.
fn single_partner(stages: &Stages) -> Option<String> {
    (stages.settings.partners.k == 1).then(|| {
        "with k = 1 a place counts once two cameras see it; no third camera confirms the match"
            .into()
    })
}

/// Warns where all clusters together reach next to nothing: the plan's shares are relative to that.
/// `band`: what they may give, where that is unsure.
fn little_fulfilled(ranking: &Ranking, band: Option<&Band>, lacks_images: bool) -> Option<String> {
    let given = ranking.reachable;
    let band = band.map_or_else(String::new, |band| format!(" (likely {band})"));
    let more = if lacks_images {
        Advice::text("first add the images that are missing or cannot be used (")
            .run("doctor")
            .and(")")
    } else {
        Advice::text("a coarser ")
            .set("target.gsd")
            .and(", more partners (")
            .set("partners.k")
            .and(") or a ")
            .set("region")
            .and(" without the background may give more")
    };
    let more = on_command_line(&more);
    // That nothing is reached at all is an error of its own.
    (!ranking.order.is_empty() && given < LITTLE).then(|| {
        format!(
            "all images together can give only {:.0} %{band} of what is wanted, and shares are of that: the report says where and why; {more}",
            100.0 * given
        )
    })
}

/// Returns whether at least a tenth of the images is missing or cannot be used.
fn lacks_images(stages: &Stages) -> bool {
    stages.without_image.len() * MISSING >= stages.scene.views.len()
}

/// Warns of a budget above all that there is, most likely counted in something else.
fn more_than_all(stages: &Stages) -> Option<String> {
    let Some(Budget::Clusters(budget)) = stages.settings.cut.budget else {
        return None;
    };
    let (all, what) = match stages.clusters.len() {
        all if stages.makes_maps => (all, "depth maps"),
        all => (all, "images"),
    };
    (budget > all as u64).then(|| {
        let budget = Advice::default().set_to("cut.budget", budget.to_string());
        let is_more = format!(" is more than the {all} {what} there are: the plan has all");
        on_command_line(&budget.and(is_more))
    })
}

/// Warns of a choice of images that nobody limited, which is rarely what a training wants.
fn no_number_of_images(stages: &Stages) -> Option<String> {
    let limits = &stages.settings.cut;
    let is_default = limits.limits() == 1 && limits.target == Some(Share(DEFAULT_TARGET));
    (!stages.makes_maps && is_default).then(|| {
        let advice = Advice::text(
            "no number of images was given: the share says how well these draw the others, and a training gains from more; set it (",
        )
        .set_to("cut.budget", "60")
        .and(" or ")
        .set_to("cut.budget", "25%")
        .and("), and keep images apart to measure the training (")
        .set_to("test_every", "8")
        .and(")");
        on_command_line(&advice)
    })
}

/// Warns of small maps for a product without depth maps.
fn unused_pilot(stages: &Stages) -> Option<String> {
    let is_named = stages.settings.pilot.maps.is_some();
    (is_named && !stages.makes_maps).then(|| {
        format!(
            "the small maps of pilot.maps are not used: {} takes the images themselves",
            stages.backend
        )
    })
}

/// Warns of so few maps that the backend's fusion is expected to keep nothing of them.
fn unconfirmed(stages: &Stages, cut: &Cut) -> Option<String> {
    let (clusters, support) = (cut.clusters, stages.objective.support as usize);
    let limits = &stages.settings.cut;
    let is_limited = limits.budget.is_some() || limits.time.is_some() || limits.points.is_some();
    (is_limited && support > 1 && cut.share <= 0.0 && clusters < support).then(|| {
        format!(
            "fusion by {} keeps points that {support} depth maps agree on, and the limits allow {clusters}: nothing will be left; raise the limit",
            stages.backend
        )
    })
}

/// Returns whether the pictures leave open what can be matched, so that the plan may be far off.
fn is_unsure(stages: &Stages, all: f64, reachable: &Band) -> bool {
    // Without pictures the band is equally wide for every scene and says nothing about this one.
    !stages.agreement.is_empty() && reachable.high - reachable.low > UNSURE * all
}

fn unsure(reachable: &Band) -> String {
    format!(
        "the pictures leave open how much will match: all images together may give {reachable} of what is wanted; plan again once the \
         first depth maps are there: what failed in them counts less"
    )
}

fn contradictions(stages: &Stages) -> Option<String> {
    let share = stages.visibility.contradictions as f64 / stages.scene.observations().max(1) as f64;
    (share > CONTRADICTIONS).then(|| {
        let what = format!(
            "{:.0} % of the observations contradict the surface (views observe points that it hides from them); \
             give a better surface with ",
            share * 100.0
        );
        on_command_line(&Advice::text(what).run("plan ").set("surface.mesh"))
    })
}

fn blurred(stages: &Stages) -> Option<String> {
    let sharpness = Sharpness::new(&stages.scene, &stages.agreement.detail);
    let blurred: Vec<&str> = sharpness
        .blurred()
        .map(|view| stages.scene.name(view))
        .collect();
    let named = blurred.iter().take(NAMED).copied();
    let named = named.collect::<Vec<_>>().join(", ");
    let more = blurred.len().saturating_sub(NAMED);
    match blurred.len() {
        0 => None,
        1 => Some(format!("{named} is blurred: less of it will match")),
        _ if more == 0 => Some(format!("{named} are blurred: less of them will match")),
        _ => Some(format!(
            "{named} and {more} more images are blurred: less of them will match"
        )),
    }
}

fn tiled(stages: &Stages) -> Option<String> {
    let tiles = stages.surface_stats.tiles;
    (tiles > 1).then(|| {
        format!(
            "the surface was built in {tiles} tiles of at most {} points; triangles at the seams differ from those of an untiled surface",
            stages.settings.surface.tile_points.unwrap_or_default()
        )
    })
}
