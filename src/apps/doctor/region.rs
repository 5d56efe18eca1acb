//! A region of which the photographs miss a part.

use super::{Finding, Inputs, Severity};
use crate::{
    base::shell::command_path,
    plan::{self, GroundSummary, photographed_ground},
    show::manifest::planned_ground,
};

pub fn findings(inputs: &Inputs) -> Option<Finding> {
    let (scene, settings) = (inputs.scene, inputs.settings);
    let place = plan::georeference(inputs.project, scene, &settings.frame);
    let now = || {
        let without_image = inputs.images.without_image(scene.views.len());
        photographed_ground(scene, &place, settings, &without_image)
            .ok()
            .flatten()
    };
    let planned = planned_ground(inputs.project, settings);
    let plans = if planned.is_some() {
        "viewrank report PROJECT"
    } else {
        "viewrank plan PROJECT --report"
    };
    let ground = planned.or_else(now).filter(GroundSummary::is_incomplete)?;
    let metres = plan::metres(settings.units, &place);
    let covered = ground.covered("the region", metres);
    let what = format!("{covered} {}", ground.missed(metres));
    let plans = plans.replace("PROJECT", &command_path(&inputs.project.home));
    let cure = format!("take images of what was missed: {plans} plans them (viewrank/flight)");
    Some(Finding::new(Severity::Warning, "region-missed", what, cure))
}
