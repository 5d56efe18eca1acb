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
    let ground = planned_ground(inputs.project, settings)
        .or_else(now)
        .filter(GroundSummary::is_incomplete)?;
    let metres = plan::metres(settings.units, &place);
    let covered = ground.covered("the region", metres);
    let what = format!("{covered} {}", ground.missed("it", metres));
    let root = command_path(&inputs.project.home);
    let cure = format!(
        "take images of what was missed: viewrank plan {root} --region FILE --report plans them (viewrank/flight)"
    );
    Some(Finding::new(Severity::Warning, "region-missed", what, cure))
}
