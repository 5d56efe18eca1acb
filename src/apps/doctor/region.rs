//! A region, and what the photographs miss of it.

use std::{fmt::Display, path::Path};

use super::{Finding, Inputs, Severity};
use crate::{
    apps::report::MOST_PLANNED,
    base::{
        advice::on_command_line,
        error::Hint,
        shell::{command_path, command_word},
    },
    model::georeference::{Georeference, SET_PLACE},
    plan::{self, GroundSummary, RegionFileError, photographed_ground, positions_in_images},
    show::manifest::planned_ground,
};

pub fn findings(inputs: &Inputs) -> Option<Finding> {
    // May read the positions in the images.
    let place = plan::georeference(inputs.project, inputs.scene, &inputs.settings.frame);
    match ground(inputs, &place) {
        Ok((ground, true)) => of_ground(inputs, &place, &ground?, true),
        Ok((ground, false)) => {
            let misread = plan::region_in_degrees(inputs.scene, &place, inputs.settings);
            match misread {
                Some(error) => Some(unusable(&error)),
                None => of_ground(inputs, &place, &ground?, false),
            }
        }
        Err(error) => Some(unusable(&error)),
    }
}

fn unusable(error: &(impl Hint + Display)) -> Finding {
    let cure = error.hint().map(|hint| on_command_line(&hint));
    let cure = cure.unwrap_or_else(|| "give another region".into());
    Finding::new(Severity::Error, "region", error.to_string(), cure)
}

/// Returns the ground of the region, and whether it is that of a plan, which has a surface.
fn ground(
    inputs: &Inputs,
    place: &Georeference,
) -> Result<(Option<GroundSummary>, bool), RegionFileError> {
    let (scene, settings) = (inputs.scene, inputs.settings);
    if let Some(planned) = planned_ground(inputs.project, settings) {
        return Ok((Some(planned), true));
    }
    let without_image = inputs.images.without_image(scene.views.len());
    let now = photographed_ground(scene, place, settings, &without_image);
    let may_quote = |file: &Path| settings.may_quote(file, &inputs.project.named);
    Ok((now.map_err(|error| error.quoting(may_quote))?, false))
}

fn of_ground(
    inputs: &Inputs,
    place: &Georeference,
    ground: &GroundSummary,
    is_planned: bool,
) -> Option<Finding> {
    let settings = inputs.settings;
    let metres = plan::metres(settings.units, place);
    if ground.unseen >= 1.0 {
        let finely_enough = ground.finely_enough(metres);
        let less = finely_enough
            .as_ref()
            .map_or("", |_| "set a larger target.gsd, or ");
        let cure = format!("{less}{}", place_of_region(inputs, place));
        let finely_enough = finely_enough.unwrap_or_default();
        let area = plan::area_in_words(ground.area, metres);
        let what = format!("no photograph shows any of the region ({area}){finely_enough}");
        return Some(Finding::new(Severity::Error, "region", what, cure));
    }
    let covered = ground.covered("the region", metres);
    let of_plane = if is_planned {
        ""
    } else {
        " Until there is a plan, this takes the ground for a plane, which hides nothing."
    };
    let what = format!("{covered} {}{of_plane}", ground.missed(metres));
    if !ground.is_incomplete() {
        // Whoever asked wants to hear it.
        let is_asked = settings.region.is_some();
        return is_asked
            .then(|| Finding::new(Severity::Note, "region", what, "nothing: it is covered"));
    }
    let project = command_path(&inputs.project.home);
    let gsd = settings.target.gsd;
    let gsd = gsd.map_or_else(String::new, |gsd| format!(" --gsd {gsd}"));
    let plans = match (is_planned, &settings.region) {
        (true, _) => format!("viewrank report {project}"),
        (false, Some(region)) => {
            let region = command_word(&String::from(region.clone()));
            format!("viewrank plan {project} --region {region}{gsd} --report")
        }
        (false, None) => format!("viewrank plan {project} --report"),
    };
    let cure = format!(
        "take images of what was missed: {plans} plans them, up to {MOST_PLANNED} (viewrank/flight)"
    );
    Some(Finding::new(Severity::Warning, "region-missed", what, cure))
}

/// Advice on a region that lies outside the photographs.
fn place_of_region(inputs: &Inputs, place: &Georeference) -> String {
    if *place != Georeference::Local {
        return "photograph it; if it is not where it was meant to be, check that its polygon has longitude before latitude, and frame.origin or \
                frame.utm"
            .into();
    }
    let gps = match positions_in_images(inputs.project, inputs.scene).1.len() {
        0 | 1 => String::new(),
        images => format!(
            "; the GPS positions of {images} images do not fit the model's cameras, or are on one line"
        ),
    };
    format!(
        "draw it in the coordinates of the model, whose place on earth is not known ({SET_PLACE}){gps}"
    )
}
