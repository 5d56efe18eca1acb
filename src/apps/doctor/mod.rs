//! Diagnoses a project before planning: views that cannot be matched and why, weak links,
//! implausible units, and traps of the backends. Reads the model and the images' headers, never
//! their pixels, and a few masks.

mod links;
mod masks;
mod model;
mod partners;
mod pictures;
mod region;
mod sense;
#[cfg(test)]
mod tests;

use std::collections::BTreeSet;

pub use model::NO_TRACKS;
pub use partners::partners_in_words;
use schemars::JsonSchema;
use serde::Serialize;

use crate::{
    backends::{self, Backend, CUT_PANORAMAS, ExaminedProject},
    base::{advice::on_command_line, shell::command_path},
    config::{Settings, UnknownBackend},
    io::project::{ImageFaults, Project},
    model::scene::{Scene, ViewIndex, ViewPoints},
    show::manifest::planned_backend,
};

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// No harm expected; every large project has some.
    Note,
    /// The result will be worse than it could be.
    Warning,
    /// The result will be wrong or missing.
    Error,
}

/// Output of `viewrank doctor --format json`.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Diagnosis {
    /// Version of this format.
    pub version: u32,
    /// The backend that partners were judged for.
    pub backend: &'static str,
    /// False for a model without views or with errors, in which partners and links are meaningless.
    pub partners_judged: bool,
    /// All findings, most severe first.
    pub findings: Vec<Finding>,
}

/// A view that a finding concerns.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct ViewFinding {
    pub name: String,
    /// Detail of this view; empty where the finding says it all.
    pub why: String,
}

impl ViewFinding {
    fn new(name: impl Into<String>, why: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            why: why.into(),
        }
    }
}

/// Something that the user should know.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Finding {
    pub severity: Severity,
    /// Identifier of the kind of finding.
    pub check: &'static str,
    /// Backends concerned; empty means all.
    pub backends: Vec<&'static str>,
    /// The finding in a sentence.
    pub what: String,
    /// The remedy: a command or an action.
    pub cure: String,
    /// Views concerned; empty means the whole project.
    pub views: Vec<ViewFinding>,
}

impl Finding {
    fn new(
        severity: Severity,
        check: &'static str,
        what: impl Into<String>,
        cure: impl Into<String>,
    ) -> Self {
        let (what, cure) = (what.into(), cure.into());
        Self {
            severity,
            check,
            backends: Vec::new(),
            what,
            cure,
            views: Vec::new(),
        }
    }

    fn of_views(self, views: Vec<ViewFinding>) -> Self {
        Self { views, ..self }
    }
}

/// Share of points or views at and above which next to nothing is left to plan.
const MOST: f64 = 0.5;
/// Shares below this are a few.
const FEW: f64 = 0.1;

/// Returns the number with its noun, as in "1 view" or "2 views".
pub(crate) fn counted(number: usize, what: &str) -> String {
    format!("{number} {what}{}", if number == 1 { "" } else { "s" })
}

/// Inputs of all checks.
struct Inputs<'a> {
    project: &'a Project,
    scene: &'a Scene,
    points: &'a ViewPoints,
    settings: &'a Settings,
    /// The backend that would be planned for.
    backend: &'a Backend,
    /// Backends whose traps are checked.
    backends: &'a [&'a Backend],
    images: &'a ImageFaults,
}

impl Inputs<'_> {
    fn view_finding(&self, view: ViewIndex, why: impl Into<String>) -> ViewFinding {
        ViewFinding::new(self.scene.name(view), why)
    }

    fn named(&self, views: impl IntoIterator<Item = ViewIndex>) -> Vec<ViewFinding> {
        views
            .into_iter()
            .map(|view| self.view_finding(view, ""))
            .collect()
    }
}

/// Examines the project: partners for the first of `backends`, traps for all of them.
pub fn examine(
    project: &Project,
    scene: &Scene,
    settings: &Settings,
    backends: &[&Backend],
) -> Diagnosis {
    let backend = backends
        .first()
        .copied()
        .unwrap_or_else(|| backends::by_default(project).0);
    let (mut findings, partners_judged) = if scene.views.is_empty() {
        (vec![no_views(scene)], false)
    } else {
        scene_findings(&Inputs {
            project,
            scene,
            points: &scene.view_points(),
            settings,
            backend,
            backends,
            images: &project.image_faults(scene),
        })
    };
    // Stable: within a severity the order of the checks stays.
    findings.sort_by_key(|finding| std::cmp::Reverse(finding.severity));
    Diagnosis {
        version: 1,
        backend: backend.name,
        partners_judged,
        findings,
    }
}

fn no_views(scene: &Scene) -> Finding {
    let why = scene
        .warnings
        .iter()
        .map(|why| format!("; {}", why.text))
        .collect::<String>();
    let cures = scene.warnings.iter().filter_map(|why| why.cure.as_ref());
    let cure = match cures.map(on_command_line).collect::<Vec<_>>().join("; ") {
        none if none.is_empty() => {
            "register the images first (viewrank inspect shows the model's contents)".into()
        }
        cures => cures,
    };
    let what = format!("no image of the model is registered{why}");
    Finding::new(Severity::Error, "no-views", what, cure)
}

/// Returns the findings, and true if partners and links were judged.
fn scene_findings(inputs: &Inputs) -> (Vec<Finding>, bool) {
    let mut findings = sense::of_model(inputs);
    findings.extend(model::findings(inputs));
    let is_sound = findings
        .iter()
        .all(|finding| finding.severity < Severity::Error);
    if is_sound {
        findings.extend(partners::findings(inputs));
        if findings.iter().all(|finding| finding.check != NO_TRACKS) {
            findings.extend(links::findings(inputs));
        }
    }
    findings.extend(region::findings(inputs));
    findings.extend(sense::of_images(inputs));
    findings.extend(masks::findings(inputs));
    findings.extend(pictures::findings(inputs));
    findings.extend(traps(inputs));
    (findings, is_sound)
}

/// Returns the backends to check: those named, else that of the project's plan, else the one that
/// the project is set up for; with `others`, all the others as well. Partners are judged for the
/// first.
///
/// # Errors
/// An unknown name.
pub fn backends_to_check(
    project: &Project,
    names: &[String],
    others: bool,
) -> Result<Vec<&'static Backend>, UnknownBackend> {
    let mut checked = backends::by_names(names)?;
    if checked.is_empty() {
        let planned = planned_backend(project).and_then(|name| backends::by_name(&name).ok());
        checked.push(planned.unwrap_or_else(|| backends::by_default(project).0));
    }
    for backend in backends::BACKENDS.iter().copied().filter(|_| others) {
        if checked
            .iter()
            .all(|known: &&Backend| known.name != backend.name)
        {
            checked.push(backend);
        }
    }
    Ok(checked)
}

/// Reports the traps of the backends: warnings for the planned backend, notes for the others.
fn traps(inputs: &Inputs) -> Vec<Finding> {
    let examined = ExaminedProject {
        project: inputs.project,
        scene: inputs.scene,
        points: inputs.points,
    };
    let mut findings: Vec<Finding> = distorted(inputs).into_iter().collect();
    for backend in inputs.backends {
        let planned = backend.name == inputs.backend.name;
        let severity = if planned {
            Severity::Warning
        } else {
            Severity::Note
        };
        for trap in (backend.traps)(&examined) {
            let views = inputs.named(trap.views);
            match findings
                .iter_mut()
                .find(|f| f.check == trap.name && f.what == trap.what)
            {
                // The planned backend is the first, so a trap that others share has its severity.
                Some(same) => same.backends.push(backend.name),
                None => {
                    let finding =
                        Finding::new(severity, trap.name, trap.what, trap.cure).of_views(views);
                    findings.push(Finding {
                        backends: vec![backend.name],
                        ..finding
                    });
                }
            }
        }
    }
    findings
}

/// Reports backends that need undistorted images where the cameras have lens distortion.
fn distorted(inputs: &Inputs) -> Option<Finding> {
    let cameras = inputs.scene.view_indices();
    let cameras = cameras.map(|view| inputs.scene.camera_of(view));
    let distorted = cameras.filter(|camera| !camera.is_pinhole());
    let models: Vec<&str> = distorted.map(|camera| camera.model().name()).collect();
    if models.is_empty() {
        return None;
    }
    let names: BTreeSet<&str> = models.iter().copied().collect();
    let names = names.into_iter().collect::<Vec<_>>().join(" or ");
    let all = inputs.scene.views.len();
    let refuse: Vec<&'static str> = inputs
        .backends
        .iter()
        .filter(|b| !b.takes_distorted)
        .map(|b| b.name)
        .collect();
    let (root, own) = (
        inputs.project.as_argument(),
        command_path(&inputs.project.place_of_undistorted()),
    );
    let cure = match inputs.project.undistorted_workspace() {
        Some(dense) => format!("viewrank plan {}", command_path(&dense)),
        None if backends::has_panoramas(inputs.scene) => CUT_PANORAMAS.into(),
        None => format!("viewrank undistort {root}, then viewrank plan {own}"),
    };
    let whose = match models.len() {
        n if n == all => format!("the cameras are {names}"),
        1 => format!("the camera of 1 of {all} views is {names}"),
        n => format!("the cameras of {n} of {all} views are {names}"),
    };
    let what = format!("{whose}, but these programs need images without lens distortion");
    let finding = Finding::new(Severity::Note, "distorted-images", what, cure);
    (!refuse.is_empty()).then_some(Finding {
        backends: refuse,
        ..finding
    })
}
