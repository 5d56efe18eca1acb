//! What the model leaves out or was not read of it.

use super::{FEW, Finding, Severity, ViewFinding, Visit, counted};
use crate::{
    io::project::ProjectKind,
    model::scene::{ModelWarning, WarningKind},
};

pub fn findings(visit: &Visit) -> Vec<Finding> {
    warnings(visit).into_iter().chain(unregistered(visit)).chain(no_images(visit)).collect()
}

/// What reading the model warns of, as plans do.
fn warnings(visit: &Visit) -> Vec<Finding> {
    let finding = |warning: &ModelWarning| {
        let (severity, check, cure) = match warning.kind {
            WarningKind::OtherModels => return other_models(visit, &warning.text),
            WarningKind::OtherWorkspace => {
                (Severity::Warning, "other-workspace", "undistort again, from this model (viewrank undistort)")
            }
            WarningKind::Damaged => (
                Severity::Warning,
                "model-not-as-it-should-be",
                "see that the model is whole: write it again with the program that made it",
            ),
            WarningKind::Guessed => (
                Severity::Warning,
                "guessed-sizes",
                "put the images where the model says they are: what is guessed of their sizes decides what they see",
            ),
            WarningKind::Format => (Severity::Note, "format", "nothing: it is how models of this format are read"),
        };
        Finding::new(severity, check, &warning.text, cure)
    };
    visit.scene.warnings.iter().map(finding).collect()
}

/// Models of which only one is read: copies of it do no harm.
fn other_models(visit: &Visit, what: &str) -> Finding {
    let others = &visit.project.other_models;
    let copies = visit.project.copies(visit.scene);
    if !copies.is_empty() && copies.len() == others.len() {
        let cure =
            "nothing, if this is the one that you mean: the others hold mostly the same images; --model takes another";
        return Finding::new(Severity::Note, "model-copies", what, cure);
    }
    let largest = others.iter().filter(|model| !copies.contains(model)).map(|model| model.registered).max();
    let few = |largest: u64| (largest as f64) < FEW * visit.scene.views.len() as f64;
    let severity = if largest.is_some_and(few) { Severity::Note } else { Severity::Warning };
    let cure = "match the images between them again; until then plan and match each by itself (--model)";
    Finding::new(severity, "other-sub-models", what, cure)
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
