//! What is written for a plan: the manifest, its table, the pair files, the pictures, and the files of backends.

use super::{Plan, PlannedViews};
use crate::{
    backends::{self, Backend, BackendError, Export, ExportOptions, Selection},
    confidence,
    error::Hint,
    georeference::Georeference,
    manifest::{FingerprintError, Manifest},
    output::{Contents, FileSet},
    pictures::{Curve, curve_svg, surface_ply, views_geojson},
    project::Project,
    report,
};

/// What is to be written for a plan.
pub struct PlanFiles {
    pub manifest: Manifest,
    /// The project's own set, then those of backends whose files go elsewhere and what an earlier plan left. To be written from the
    /// last to the first: what the manifest says is then there.
    pub sets: Vec<FileSet>,
    /// What runs the first of the backends on its files, to be typed in a shell.
    pub command: Option<String>,
}

/// Why a plan cannot be written down.
#[derive(Debug, thiserror::Error)]
pub enum FilesError {
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(transparent)]
    Input(#[from] FingerprintError),
}

impl Hint for FilesError {
    fn hint(&self) -> Option<String> {
        match self {
            Self::Backend(error) => error.hint(),
            Self::Input(error) => error.hint(),
        }
    }
}

/// The files of the plan, to be written by [`FileSet::write`].
pub fn files(plan: &Plan, project: &Project) -> Result<PlanFiles, FilesError> {
    let clusters: Vec<_> = plan.ranked().take(plan.cut.clusters).collect();
    let selection = Selection {
        project,
        scene: &plan.scene,
        clusters: &clusters,
        image_scale: plan.settings.image_scale,
        planned_for: plan.backend,
    };
    let (exports, mut missing) = exports(&selection, &wanted(plan, project)?)?;
    let pair_files = backends::pair_files("the list of view clusters", &selection).map(Vec::from);
    let pair_files = pair_files.or_else(|error| match error {
        BackendError::Name { .. } => {
            missing.push(format!("no clusters.txt, pairs.txt and baseImages.txt: {error}"));
            Ok(Vec::new())
        }
        error => Err(error),
    })?;
    let records = exports.iter().map(|export| export.record.clone()).collect();
    let mut manifest = Manifest::new(plan, project, records)?;
    manifest.warnings.extend(missing);
    let command = exports.first().and_then(command);
    let mut own = FileSet::new(&project.root, "plan");
    let mut add = |name: &str, text: String| own.add_text(format!("viewrank/{name}"), text);
    let stale = stale_page(project, &manifest);
    add("manifest.json", manifest.to_json());
    add("manifest.csv", manifest.to_csv());
    pair_files.into_iter().for_each(|(name, text)| add(name, text));
    let planned_views = PlannedViews::new(&plan.scene, &plan.finished);
    add("planned_views.json", serde_json::to_string(&planned_views).expect("numbers and texts are JSON") + "\n");
    add("curve.svg", curve_svg(&Curve::predicted(plan)));
    let place = Georeference::find(project, &plan.scene, &plan.settings.frame);
    add("views.geojson", views_geojson(plan, &place));
    add("timings.json", serde_json::to_string_pretty(&plan.timings).expect("numbers by name are JSON") + "\n");
    own.add("viewrank/surface.ply", Contents::Bytes(surface_ply(plan)));
    let elsewhere: Vec<FileSet> = exports.into_iter().filter_map(|export| own.absorb(export.files)).collect();
    let sets = std::iter::once(own).chain(elsewhere).chain(cache(plan, project)).chain(stale).collect();
    Ok(PlanFiles { manifest, sets, command })
}

/// The page that shows another plan than this one goes.
fn stale_page(project: &Project, manifest: &Manifest) -> Option<FileSet> {
    let earlier = std::fs::read(project.output_folder().join("manifest.json"));
    let shows_another = earlier.map_or(true, |earlier| earlier != manifest.to_json().as_bytes());
    let there = project.root.join(report::FILE).exists();
    (there && shows_another).then(|| FileSet::new(&project.root, report::SET))
}

/// What the pictures showed, for the next plan, if there is something new.
fn cache(plan: &Plan, project: &Project) -> Option<FileSet> {
    let bytes = plan.pictures.cache.clone()?;
    let mut set = FileSet::new(&project.root, "cache");
    set.add(confidence::CACHE, Contents::Bytes(bytes));
    Some(set)
}

/// The first command of an export, from its folder.
fn command(export: &Export) -> Option<String> {
    let folder = backends::shell_quoted(&export.files.root.display().to_string());
    Some(format!("cd {folder} && {}", export.record.commands.first()?))
}

/// The files of each backend. One that lacks something gets none, which a warning says: the plan is good without them.
fn exports(
    selection: &Selection,
    backends: &[&'static dyn Backend],
) -> Result<(Vec<Export>, Vec<String>), BackendError> {
    let (mut exports, mut missing) = (Vec::new(), Vec::new());
    for backend in backends {
        match backend.export(selection, &ExportOptions::default()) {
            Ok(export) => exports.push(export),
            Err(BackendError::Needs { backend, what, hint }) => {
                missing.push(format!("no files for {backend}, which needs {what}: {hint}"));
            }
            Err(error) => return Err(error),
        }
    }
    Ok((exports, missing))
}

/// The backends that were asked for, else those that the project is set up for.
fn wanted(plan: &Plan, project: &Project) -> Result<Vec<&'static dyn Backend>, BackendError> {
    if plan.settings.backends.is_empty() {
        return Ok(backends::all().iter().copied().filter(|backend| backend.serves(project)).collect());
    }
    plan.settings.backends.iter().map(|name| backends::by_name(name)).collect()
}
