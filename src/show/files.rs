//! The files of a plan: manifest and its table, pair files, pictures, and the files of the
//! backends.

use std::path::{Path, PathBuf};

use super::outdated;
use crate::{
    backends::{
        self, Backend, BackendError, Export, ExportOptions, ExportRecord, Selection, place,
    },
    base::{
        error::{Advice, Hint},
        input::FileKind,
        paths,
        printable::json_escaped,
        shell::{command_path, one_after_other},
    },
    io::{
        output::{self, Contents, Disk, FileSet, OutputError},
        project::{ImageFaults, Project, ProjectError},
    },
    model::{cluster::RankedCluster, georeference::Georeference},
    plan::{EmptyPlan, Plan, PlannedViews},
    show::{
        manifest::{self, FingerprintError, Manifest},
        pictures::{FulfilmentCurve, curve_svg, surface_ply, views_file, views_geojson},
    },
};

use serde_json::json;

/// Path of the report in its project, and the name of its file set. Writing a plan marks the report
/// of any other plan as stale.
pub const REPORT_FILE: &str = "viewrank/report.html";
pub const REPORT_SET: &str = "report";
/// Path prefix of the report's flight plan.
const FLIGHT: &str = "viewrank/flight/";
/// Begin of a page, and what it becomes when another plan is made.
const FRESH: &str = "<html lang=\"en\">";
const STALE: &str = "<html lang=\"en\" data-stale>";
/// Bytes of a page that hold either.
const BEGIN: usize = 200;

/// Returns the path of the report of a plan in this folder, to be shown.
pub fn report_path(home: &Path) -> PathBuf {
    REPORT_FILE
        .split('/')
        .fold(home.to_path_buf(), |path, name| path.join(name))
}

/// The files to write for a plan.
pub struct PlanFiles {
    pub manifest: Manifest,
    /// The plan's own files first, then those of each backend (one set per folder), the caches and
    /// outdated sets to remove; all are written together.
    pub sets: Vec<FileSet>,
    /// Exports of earlier plans that stay in the project, one line each; not part of the plan.
    pub outdated_exports: Vec<String>,
    /// Warns that the images to take are those of an earlier plan.
    pub outdated_flight: Option<String>,
    pub place: Georeference,
    /// Backends without files, one line each with the reason.
    pub not_exported: Vec<String>,
    /// Shell command that runs the first backend on its files, or what to do with files that no one
    /// program reads.
    pub next: Option<String>,
}

impl PlanFiles {
    /// Writes all sets; returns a warning if the next plan will find no cache.
    ///
    /// # Errors
    /// Fails like [`output::write_all`].
    pub fn write(&self, disk: &Disk) -> Result<Option<String>, OutputError> {
        let uncached = output::write_all(&self.sets, disk)?
            .into_iter()
            .find_map(|set| set.failed);
        Ok(uncached.map(|why| {
            format!("the next plan will begin anew, because its cache cannot be written: {why}")
        }))
    }
}

/// Errors of collecting the files of a plan.
#[derive(Debug, thiserror::Error)]
pub enum FilesError {
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(transparent)]
    Input(#[from] FingerprintError),
    #[error(transparent)]
    EmptyPlan(#[from] EmptyPlan),
    #[error(transparent)]
    Project(#[from] ProjectError),
}

impl Hint for FilesError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::Backend(error) => error.hint(),
            Self::Input(error) => error.hint(),
            Self::EmptyPlan(error) => error.hint(),
            Self::Project(error) => error.hint(),
        }
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::Backend(error) => error.path(),
            Self::Input(error) => error.path(),
            Self::EmptyPlan(error) => error.path(),
            Self::Project(error) => error.path(),
        }
    }
}

/// As [`files`], for a model that has not changed since the project was opened.
///
/// # Errors
/// As [`files`]; a model that has changed is the error even if its files are gone.
pub fn files_of_same_model(plan: &Plan, project: &Project) -> Result<PlanFiles, FilesError> {
    let files = files(plan, project);
    // After them, since the model may change while they are collected.
    project.refuse_changed_model()?;
    files
}

/// Collects the files of the plan, for [`output::write_all`](crate::io::output::write_all).
///
/// # Errors
/// Fails if the plan chooses nothing, a backend does not support a name, or a mesh can no longer be
/// read. The manifest's fingerprint is of the model's files as they are now: see
/// [`Project::refuse_changed_model`].
pub fn files(plan: &Plan, project: &Project) -> Result<PlanFiles, FilesError> {
    if let Some(empty) = EmptyPlan::detect(plan) {
        return Err(empty.into());
    }
    let clusters: Vec<_> = plan.ranked().take(plan.decision.cut.clusters).collect();
    let selection = selection(plan, project, &clusters, &plan.stages.image_faults);
    let (exports, not_exported) = exports(&selection, &wanted(plan, project)?)?;
    let mut missing = not_exported.clone();
    missing.extend(unfit_default(&selection, plan));
    let lists = lists(&selection, &mut missing)?;
    let records = exports.iter().map(|export| export.record.clone()).collect();
    let place = plan.stages.place;
    // Fingerprint and surface take one thread each.
    let (manifest, (surface, views)) = rayon::join(
        || Manifest::new(plan, project, records),
        || rayon::join(|| surface_ply(plan), || views_geojson(plan, &place)),
    );
    let mut manifest = manifest?;
    let of_images = &plan.stages.image_faults;
    let faults = of_images.warnings(project, &plan.stages.scene);
    manifest.warnings.extend(faults.into_iter().chain(missing));
    let has_images = of_images.is_any_usable(plan.stages.scene.views.len());
    let first = exports.first();
    let next = first.and_then(|export| next_step(export, project.images.is_some() && has_images));
    let stale = stale_page(project, &manifest);
    let is_stale = stale.is_some();
    let mut own = own_files(plan, project, &manifest);
    for (name, text) in lists {
        own.add_text(format!("viewrank/{name}"), text);
    }
    own.add_text(format!("viewrank/{}", views_file(&place)), views);
    own.add("viewrank/surface.ply", Contents::Bytes(surface));
    let exports = exports.into_iter().map(|export| {
        let folder = export.files.root.clone();
        place::set_of_folder(&folder, [export.files], project)
    });
    let sets: Vec<FileSet> = std::iter::once(own)
        .chain(exports)
        .chain(plan.unwritten())
        .chain(stale)
        .collect();
    let outdated_exports = outdated::exports(plan, project, &sets);
    let outdated_flight = is_flight_outdated(project, is_stale).then(|| {
        let again = command_path(&project.home);
        format!("viewrank/flight is of an earlier plan; for this one: viewrank report {again}")
    });
    Ok(PlanFiles {
        manifest,
        sets,
        outdated_exports,
        outdated_flight,
        place,
        not_exported,
        next,
    })
}

/// The lists of view clusters and pairs, none where they cannot hold a name; `missing` gets why.
fn lists(
    selection: &Selection,
    missing: &mut Vec<String>,
) -> Result<Vec<(&'static str, String)>, BackendError> {
    let lists = backends::pair_files("the list of view clusters", selection);
    lists.or_else(|error| match error {
        BackendError::Name { .. } => {
            missing.push(format!(
                "did not write clusters.txt, pairs.txt and baseImages.txt: {error}"
            ));
            Ok(Vec::new())
        }
        error => Err(error),
    })
}

/// Returns whether there are images to take, of another plan. `is_stale`: the page becomes so now.
fn is_flight_outdated(project: &Project, is_stale: bool) -> bool {
    let is_marked = || {
        let page = output::read_own(&project.home, REPORT_FILE, FileKind::Plan);
        let is_of_another = |page: Vec<u8>| {
            let begin = &page[..page.len().min(BEGIN)];
            String::from_utf8_lossy(begin).contains(STALE)
        };
        page.is_ok_and(is_of_another)
    };
    let listed = output::recorded(&project.home, REPORT_SET).into_iter();
    let mut flight = listed.filter(|path| path.starts_with(FLIGHT));
    flight.any(|path| output::open_own(&project.home, &path).is_ok()) && (is_stale || is_marked())
}

fn selection<'a>(
    plan: &'a Plan,
    project: &'a Project,
    clusters: &'a [RankedCluster],
    image_faults: &'a ImageFaults,
) -> Selection<'a> {
    Selection {
        project,
        scene: &plan.stages.scene,
        clusters,
        image_scale: plan.stages.settings.image_scale(),
        own_size: plan.stages.own_size,
        planned_for: plan.stages.backend,
        image_faults,
        test_every: plan.stages.settings.test_every,
    }
}

/// Returns the files of the plan that take no time to make.
fn own_files(plan: &Plan, project: &Project, manifest: &Manifest) -> FileSet {
    let mut own = FileSet::new(&project.home, "plan");
    let mut add = |name: &str, text: String| own.add_text(format!("viewrank/{name}"), text);
    // Leads later commands from the folder of `--out` back to the project.
    if project.is_elsewhere() {
        let root = paths::absolute(&project.root);
        add(
            "project.json",
            json!({ "project": root }).to_string() + "\n",
        );
    }
    add("manifest.json", manifest.to_json());
    add("manifest.csv", manifest.to_csv());
    let planned_views = PlannedViews::new(&plan.stages.scene, &plan.finished);
    add(
        "planned_views.json",
        json_escaped(&serde_json::to_string(&planned_views).expect("numbers and texts are JSON"))
            + "\n",
    );
    add("curve.svg", curve_svg(&FulfilmentCurve::predicted(plan)));
    add(
        "timings.json",
        serde_json::to_string_pretty(&plan.timings).expect("numbers by name are JSON") + "\n",
    );
    own
}

/// Returns the report of an earlier plan with a note that a newer plan exists, so that a page open
/// in a browser survives a reload.
fn stale_page(project: &Project, manifest: &Manifest) -> Option<FileSet> {
    let earlier = output::read_own(&project.home, manifest::FILE, FileKind::Plan);
    let shows_another = earlier.map_or(true, |earlier| earlier != manifest.to_json().as_bytes());
    if !shows_another || !project.home.join(REPORT_FILE).exists() {
        return None;
    }
    let mut set = FileSet::new(&project.home, REPORT_SET);
    // A page that cannot be read is removed, because it shows another plan.
    let page = output::read_own(&project.home, REPORT_FILE, FileKind::Plan)
        .ok()
        .and_then(|page| String::from_utf8(page).ok());
    if let Some(page) = page {
        set.add_text(REPORT_FILE, page.replacen(FRESH, STALE, 1));
        // Keeps the flight plan that the page shows. Records may be forged, so other paths are
        // ignored.
        let listed = output::recorded(&project.home, REPORT_SET).into_iter();
        for path in listed.filter(|path| path.starts_with(FLIGHT)) {
            if output::open_own(&project.home, &path).is_ok() {
                set.add(&*path, Contents::Copy(project.home.join(&path)));
            }
        }
    }
    Some(set)
}

/// Returns the shell command that enters the folder of the export and starts its runner, or else
/// its first command; without one, what to do with the folder. `None` if that needs the images
/// first.
fn next_step(export: &Export, has_images: bool) -> Option<String> {
    let folder = command_path(&export.files.root);
    let record = &export.record;
    let runner = record.runner.as_ref().map(|runner| format!("./{runner}"));
    match runner.as_ref().or(record.commands.first()) {
        Some(command) => Some(one_after_other(&format!("cd {folder}"), command)),
        None => has_images.then(|| format!("give {folder} to your program")),
    }
}

/// Makes the files of a backend for the first `clusters` clusters of a plan in memory;
/// [`FileSet::write`] writes them. Returns the folder of the export, which is below the root of the
/// files if that is the project, the files, and the record.
///
/// # Errors
/// Fails like [`Backend::export`], or if the folder is occupied by other files.
pub fn export(
    plan: &Plan,
    project: &Project,
    backend: &Backend,
    clusters: usize,
    options: &ExportOptions,
) -> Result<(PathBuf, FileSet, ExportRecord), BackendError> {
    let clusters: Vec<_> = plan.ranked().take(clusters).collect();
    let image_faults = project.image_faults(&plan.stages.scene);
    let selection = selection(plan, project, &clusters, &image_faults);
    let export = backend.export(&selection, options)?;
    let folder = export.files.root.clone();
    place::check(&folder, std::slice::from_ref(&export), project)?;
    let files = place::set_of_folder(&folder, [export.files], project);
    Ok((folder, files, export.record))
}

/// Returns the files of each backend, and a warning for each backend without files: the plan is
/// useful without them.
fn exports(
    selection: &Selection,
    backends: &[&'static Backend],
) -> Result<(Vec<Export>, Vec<String>), BackendError> {
    let (mut exports, mut missing) = (Vec::new(), Vec::new());
    for backend in backends {
        let checked = backend
            .export(selection, &ExportOptions::default())
            .and_then(|export| {
                place::check(
                    &export.files.root,
                    std::slice::from_ref(&export),
                    selection.project,
                )
                .map(|()| export)
            });
        match checked {
            Ok(export) => exports.push(export),
            Err(BackendError::Needs {
                backend,
                what,
                hint,
            }) => {
                missing.push(not_exported(backend, &what, &hint));
            }
            Err(
                error @ (BackendError::OtherExport { .. }
                | BackendError::OtherModel(_)
                | BackendError::OwnFile(_)
                | BackendError::Place(_)),
            ) => {
                missing.push(format!("did not export to {}: {error}", backend.name));
            }
            Err(error) => return Err(error),
        }
    }
    Ok((exports, missing))
}

/// Says what the default backend lacks of the images, which nobody has it exported to yet.
fn unfit_default(selection: &Selection, plan: &Plan) -> Option<String> {
    let is_named = !plan.stages.settings.backends.is_empty();
    let backend = backends::by_name(plan.stages.backend).ok()?;
    if is_named || selection.project.images.is_none() || (backend.serves)(selection.project) {
        return None;
    }
    let images = if backend.takes_distorted {
        selection.images(backend.name)
    } else {
        selection.undistorted_images(backend.name)
    };
    match images {
        Err(BackendError::Needs { what, hint, .. }) => {
            Some(not_exported(backend.name, &what, &hint))
        }
        _ => None,
    }
}

fn not_exported(backend: &str, what: &str, hint: &str) -> String {
    format!("did not export to {backend}, which needs {what}: {hint}")
}

/// Returns the backends in the settings, or else those that the project is set up for.
fn wanted(plan: &Plan, project: &Project) -> Result<Vec<&'static Backend>, BackendError> {
    if plan.stages.settings.backends.is_empty() {
        return Ok(backends::BACKENDS
            .iter()
            .copied()
            .filter(|backend| (backend.serves)(project))
            .collect());
    }
    Ok(backends::by_names(&plan.stages.settings.backends)?)
}
