//! What the model leaves out or was not read of it.

use super::{FEW, Finding, Severity, ViewFinding, Visit, counted};
use crate::project::{Project, ProjectKind};

pub fn findings(visit: &Visit) -> Vec<Finding> {
    warnings(visit).into_iter().chain(unregistered(visit)).chain(no_images(visit)).collect()
}

/// What reading the model warns of, as plans do.
fn warnings(visit: &Visit) -> Vec<Finding> {
    let Project { other_models, .. } = visit.project;
    let views = visit.scene.views.len();
    let largest = other_models.iter().map(|model| model.registered).max().unwrap_or(0);
    let severity = if (largest as f64) < FEW * views as f64 { Severity::Note } else { Severity::Warning };
    let sub_models = visit.project.sub_model_warning(views);
    let workspace = visit.project.other_workspace_warning();
    let finding = |warning: &String| {
        if Some(warning) == sub_models.as_ref() {
            let cure = "match the images between them again; until then plan and match each by itself (--model)";
            Finding::new(severity, "other-sub-models", warning, cure)
        } else if Some(warning) == workspace.as_ref() {
            let cure = "undistort again, from this model (viewrank undistort)";
            Finding::new(Severity::Warning, "other-workspace", warning, cure)
        } else {
            let cure = "see that the model is whole: write it again with the program that made it";
            Finding::new(Severity::Warning, "model-not-as-it-should-be", warning, cure)
        }
    };
    visit.scene.warnings.iter().map(finding).collect()
}

/// Images without a pose.
fn unregistered(visit: &Visit) -> Option<Finding> {
    let left = &visit.scene.unregistered;
    let all = left.len() + visit.scene.views.len();
    let severity = if (left.len() as f64) < FEW * all as f64 { Severity::Note } else { Severity::Warning };
    (!left.is_empty()).then(|| {
        let what = format!("{} of {} have no pose in the model and take no part", left.len(), counted(all, "image"));
        let cure = "match them with more others in structure from motion, or take them out of the folder";
        let views = left.iter().map(|name| ViewFinding::new(name, "")).collect();
        Finding::new(severity, "unregistered-images", what, cure).of_views(views)
    })
}

fn no_images(visit: &Visit) -> Option<Finding> {
    let alone = visit.project.kind == ProjectKind::BareModel;
    let severity = if alone { Severity::Note } else { Severity::Warning };
    visit.project.images.is_none().then(|| {
        let what = "there is no folder with the images: they cannot be looked at, nor matched";
        let cure = format!("put them into {}", visit.project.root.join("images").display());
        Finding::new(severity, "no-images", what, cure)
    })
}
