//! `viewrank train`: learns from finished depth maps where a backend succeeds.

use std::path::{Path, PathBuf};

use crate::{
    apps::{
        evaluate,
        learn::{self, TrainingOptions, TrainingProject},
    },
    backends,
    base::shell::command_path,
    config::CommandLineSettings,
    io::{
        depthmaps::{self, DepthMapFormat},
        output::{self, Disk},
        project::Project,
    },
    method::confidence::{TrainedError, TrainedModel},
    model::cluster::ViewCluster,
    plan::{Plan, Timings},
    show::manifest::WrittenPlan,
};
use crate::{backends::planned_for, model::cluster::RankedCluster};
use clap::Args;

use super::{Failure, Format, config, json, print, progress::Progress, use_threads};

/// Train a confidence model on finished depth maps.
///
/// No ground truth is needed: a depth is right where depth maps from other viewpoints agree with it, wrong where they saw through it. The
/// partners that each map was matched with are those of the matcher's report, of the maps themselves (OpenMVS), or of the
/// project's plan. Use the model with viewrank plan --confidence MODEL, or write it to PROJECT/viewrank/confidence.model, which
/// --confidence auto takes.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(required = true, value_name = "PROJECT", value_parser = super::arguments::project())]
    projects: Vec<PathBuf>,

    /// Depth maps to learn from: colmap, openmvs, mvsnet, acmm, sgm, or a folder in each project
    #[arg(long, value_name = "KIND|DIR")]
    depth_maps: String,
    /// Model file to write
    #[arg(long, value_name = "MODEL")]
    out: PathBuf,
    /// Backend that made the depth maps [default: by their format]
    #[arg(long, value_name = "NAME")]
    backend: Option<String>,
    /// Seed of all random choices
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Threads to use; the model is the same for any number [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// No progress and no summary
    #[arg(long, short)]
    quiet: bool,
    /// Format of the figures on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// A planned project with its maps.
struct Prepared {
    project: Project,
    plan: Plan,
    maps: depthmaps::DepthMapSet,
    clusters: Vec<ViewCluster>,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    refuse_to_replace(&arguments.out)?;
    use_threads(arguments.threads);
    let progress = Progress::new(arguments.quiet);
    let prepared: Vec<Prepared> =
        arguments.projects.iter().map(|root| prepare(arguments, root, &progress)).collect::<Result<_, _>>()?;
    let name = backend(arguments, &prepared[0].maps.maps[0].format);
    let backend = backends::by_name(&name)?;
    let lessons: Vec<TrainingProject> = prepared.iter().map(lesson).collect();
    let min_matches = backend.planning.confidence.min_matches;
    let course = TrainingOptions { backend: backend.name.into(), min_matches, seed: arguments.seed };
    let trained = learn::train(&lessons, &course, &progress)?;
    if let Some(folder) = arguments.out.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        output::make_folder(folder, &Disk::REAL)?;
    }
    output::replace(&arguments.out, &trained.to_bytes(), &Disk::REAL)?;
    progress.finish();
    match arguments.format {
        Format::Json => print(&json(&trained.measured)),
        Format::Text if arguments.quiet => Ok(()),
        Format::Text => print(&text(arguments, &trained)),
    }
}

/// Refuses to replace any existing file except a model: it is the user's.
fn refuse_to_replace(out: &Path) -> Result<(), Failure> {
    let is_other = match TrainedModel::read(out) {
        Ok(_) | Err(TrainedError::Version { .. }) => false,
        Err(_) => out.symlink_metadata().is_ok(),
    };
    if is_other { Ok(output::refuse_to_replace(out)?) } else { Ok(()) }
}

fn prepare(arguments: &Arguments, root: &Path, progress: &Progress) -> Result<Prepared, Failure> {
    let project = Project::open_or_planned(root, None)?;
    let folder = depthmaps::folder_of(&project.root, project.dense_workspace.as_deref(), &arguments.depth_maps);
    let mut typed = CommandLineSettings::default();
    typed.set("train", "confidence.source", Some("geometric"));
    let mut settings = config::load(Some(&project.root), typed)?.settings;
    let project = project.with_images(settings.images.as_deref());
    let scene = project.read_scene()?;
    let found = depthmaps::find(&folder, &scene)?.into_complete()?;
    settings.backends = vec![backend(arguments, &found.maps[0].format)];
    let plan =
        Plan::from_scene(&project, scene, &settings, &planned_for(&project, &settings)?, Timings::start(), progress)?;
    let ranked = |cluster: &RankedCluster| ViewCluster { key: cluster.key, partners: cluster.partners.clone() };
    let written: Vec<ViewCluster> =
        WrittenPlan::read(root).map(|written| written.clusters.iter().map(ranked).collect()).unwrap_or_default();
    let clusters = evaluate::tried(&folder, &found.maps, &plan.stages.scene, &written)?;
    Ok(Prepared { project, plan, maps: found, clusters })
}

fn lesson(prepared: &Prepared) -> TrainingProject<'_> {
    let root = &prepared.project.root;
    TrainingProject {
        name: root.file_name().unwrap_or(root.as_os_str()).to_string_lossy().into_owned(),
        model: prepared.plan.stages.model(),
        candidates: &prepared.plan.stages.candidates,
        clusters: prepared.clusters.clone(),
        maps: prepared.maps.maps.clone(),
        images: prepared.project.images.clone(),
    }
}

fn backend(arguments: &Arguments, format: &DepthMapFormat) -> String {
    let by_format = match format {
        DepthMapFormat::ColmapGeometric | DepthMapFormat::ColmapPhotometric => "colmap",
        DepthMapFormat::OpenMvs => "openmvs",
        DepthMapFormat::Pfm => "mvsnet",
        DepthMapFormat::Dmb => "acmm",
        DepthMapFormat::Gipuma => "gipuma",
        DepthMapFormat::Mve => "mve",
        DepthMapFormat::AliceVision => "alicevision",
        DepthMapFormat::Npy => "sgm",
    };
    arguments.backend.clone().unwrap_or_else(|| by_format.into())
}

fn text(arguments: &Arguments, trained: &TrainedModel) -> String {
    let m = &trained.measured;
    let projects = trained.trained_on.len();
    let maps: usize = trained.trained_on.iter().map(|t| t.depth_maps).sum();
    format!(
        "Trained on {maps} depth maps of {projects} project{} for {}.\n\n\
         On scenes (of a single one: views) that were left out, while the others were trained on:\n\
         {:>10} triangles of view clusters: area under the curve {:.3}, Brier score {:.3}, calibration error {:.3}\n\
         {:>10} pixels by the picture alone: area under the curve {:.3}, Brier score {:.3}\n\n\
         Next: viewrank plan {} --confidence {}\n",
        if projects == 1 { "" } else { "s" },
        trained.backend,
        m.triangles,
        m.auc,
        m.brier,
        m.calibration_error,
        m.pixels,
        m.pixel_auc,
        m.pixel_brier,
        command_path(&arguments.projects[0]),
        arguments.out.display(),
    )
}
