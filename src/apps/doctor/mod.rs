//! What is wrong with a project before anything is planned: which views can't be matched and why, links that are weak, units that can't be
//! true, and which backends would stumble over it. Reads the model and the images' headers, never the images.

mod links;
mod model;
mod partners;
mod sense;
#[cfg(test)]
mod tests;

pub use partners::partners_in_words;
use schemars::JsonSchema;
use serde::Serialize;

use crate::{
    backends::{self, Backend, Patient},
    base::shell::quoted_path,
    config::Settings,
    io::project::{ImageFaults, Project},
    model::scene::{Scene, ViewIndex, ViewPoints},
};

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Good to know; every large project has some.
    Note,
    /// The result will be worse than it could be.
    Warning,
    /// The result will be wrong, or there will be none.
    Error,
}

/// What `viewrank doctor --format json` prints.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Diagnosis {
    /// Version of this format.
    pub version: u32,
    /// The backend that partners were judged for.
    pub backend: &'static str,
    /// The worst first.
    pub findings: Vec<Finding>,
}

/// A view that a finding is of.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct ViewFinding {
    pub name: String,
    /// What is to be said of it; empty where the finding says all.
    pub why: String,
}

impl ViewFinding {
    fn new(name: impl Into<String>, why: impl Into<String>) -> Self {
        Self { name: name.into(), why: why.into() }
    }
}

/// Something that the user should know.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Finding {
    pub severity: Severity,
    /// The same for the same kind of finding.
    pub check: &'static str,
    /// Backends that it concerns; empty: all.
    pub backends: Vec<&'static str>,
    /// A sentence.
    pub what: String,
    /// What to type or do.
    pub cure: String,
    /// The views concerned; empty: the whole project.
    pub views: Vec<ViewFinding>,
}

impl Finding {
    fn new(severity: Severity, check: &'static str, what: impl Into<String>, cure: impl Into<String>) -> Self {
        let (what, cure) = (what.into(), cure.into());
        Self { severity, check, backends: Vec::new(), what, cure, views: Vec::new() }
    }

    fn of_views(self, views: Vec<ViewFinding>) -> Self {
        Self { views, ..self }
    }
}

/// From this share of all on it is no longer a few.
const FEW: f64 = 0.1;

/// "1 view", "2 views".
fn counted(number: usize, what: &str) -> String {
    format!("{number} {what}{}", if number == 1 { "" } else { "s" })
}

/// Everything that is looked at.
struct Visit<'a> {
    project: &'a Project,
    scene: &'a Scene,
    points: &'a ViewPoints,
    settings: &'a Settings,
    /// The one that would be planned for.
    backend: &'a dyn Backend,
    /// Those whose traps are looked for.
    backends: &'a [&'a dyn Backend],
    images: &'a ImageFaults,
}

impl Visit<'_> {
    fn of(&self, view: ViewIndex, why: impl Into<String>) -> ViewFinding {
        ViewFinding::new(self.scene.name(view), why)
    }

    fn named(&self, views: impl IntoIterator<Item = ViewIndex>) -> Vec<ViewFinding> {
        views.into_iter().map(|view| self.of(view, "")).collect()
    }
}

/// Looks at the project. The plan would be made for the first of `backends`; the traps of all of them are looked for.
pub fn examine(project: &Project, scene: &Scene, settings: &Settings, backends: &[&dyn Backend]) -> Diagnosis {
    let backend = backends.first().copied().unwrap_or_else(|| backends::for_project(project));
    let mut findings = match scene.views.is_empty() {
        true => vec![no_views()],
        false => of_scene(&Visit {
            project,
            scene,
            points: &scene.view_points(),
            settings,
            backend,
            backends,
            images: &project.image_faults(scene),
        }),
    };
    findings.sort_by_key(|finding| std::cmp::Reverse(finding.severity));
    Diagnosis { version: 1, backend: backend.name(), findings }
}

fn no_views() -> Finding {
    let cure = "register the images first; viewrank inspect shows what the model holds";
    Finding::new(Severity::Error, "no-views", "no image of the model is registered", cure)
}

fn of_scene(visit: &Visit) -> Vec<Finding> {
    let mut findings = sense::of_model(visit);
    findings.extend(model::findings(visit));
    // In a model that makes no sense partners and links say nothing.
    if findings.iter().all(|finding| finding.severity < Severity::Error) {
        findings.extend(partners::findings(visit));
        findings.extend(links::findings(visit));
    }
    findings.extend(sense::of_images(visit));
    findings.extend(traps(visit));
    findings
}

/// Traps of the backends; those of the planned one are warnings, those of others notes.
fn traps(visit: &Visit) -> Vec<Finding> {
    let patient = Patient { project: visit.project, scene: visit.scene, points: visit.points };
    let mut findings: Vec<Finding> = distorted(visit).into_iter().collect();
    for backend in visit.backends {
        let planned = backend.name() == visit.backend.name();
        let severity = if planned { Severity::Warning } else { Severity::Note };
        for trap in backend.traps(&patient) {
            let views = visit.named(trap.views);
            match findings.iter_mut().find(|f| f.check == trap.name && f.what == trap.what) {
                Some(same) => same.backends.push(backend.name()),
                None => {
                    let finding = Finding::new(severity, trap.name, trap.what, trap.cure).of_views(views);
                    findings.push(Finding { backends: vec![backend.name()], ..finding });
                }
            }
        }
    }
    findings
}

/// Programs that want images without lens distortion.
fn distorted(visit: &Visit) -> Option<Finding> {
    let of_view = |v: &ViewIndex| !visit.scene.camera_of(*v).is_pinhole();
    let camera = visit.scene.camera_of(visit.scene.view_indices().find(of_view)?).model().name();
    let refuse: Vec<&'static str> = visit.backends.iter().filter(|b| !b.takes_distorted()).map(|b| b.name()).collect();
    let (root, own) = (visit.project.as_argument(), quoted_path(&visit.project.root.join("dense")));
    let cure = match &visit.project.dense_workspace {
        Some(dense) if *dense != visit.project.root => format!("viewrank plan {}", quoted_path(dense)),
        _ => format!("viewrank undistort {root}, then viewrank plan {own}"),
    };
    let what = format!("the cameras are {camera}, and these programs want images without lens distortion");
    let finding = Finding::new(Severity::Note, "distorted-images", what, cure);
    (!refuse.is_empty()).then_some(Finding { backends: refuse, ..finding })
}
