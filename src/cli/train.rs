//! `viewrank train`: learns from finished depth maps where a backend succeeds.

use std::{
    io::ErrorKind,
    path::{Path, PathBuf},
};

use crate::{
    apps::{
        evaluate,
        learn::{self, Fitted, Lesson, Numbers},
    },
    backends::{self, planned_for},
    base::{
        error::{Advice, Hint},
        shell::command_path,
    },
    config::{CommandLineSettings, ConfidenceSource},
    io::{
        depthmaps::{self, DepthMapFormat},
        output::{self, Disk},
        project::Project,
    },
    model::cluster::{RankedCluster, ViewCluster},
    plan::{Plan, Timings},
    show::manifest::{WrittenPlan, WrittenPlanError},
};
use clap::Args;

use super::{Failure, Format, config, print, print_json, progress::ProgressDisplay, use_threads};

/// Fit the confidence to finished depth maps.
///
/// Learns how often the backend matches where the pictures of a pair agree on the surface, where
/// they don't, and how many matches it needs: the settings confidence.agree, .differ,
/// .full_agreement and .min_matches. No ground truth is needed: what counts is whether a map has a
/// depth. The partners that each map was matched with are those of the matcher's report, of the
/// maps themselves (OpenMVS), or of the project's plan. Copy the printed lines into viewrank.toml.
///
/// They decide about partners and what is said of all maps together; the order of depth maps and
/// their shares come mostly from thumbnails. Of programs that give every pixel a depth, as
/// PatchmatchNet does, there is nothing to learn this way.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(required = true, value_name = "PROJECT", value_parser = super::arguments::project())]
    projects: Vec<PathBuf>,

    /// Depth maps to learn from: colmap, openmvs, mvsnet, patchmatchnet, acmm, gipuma, mve,
    /// alicevision, micmac, sgm, or a folder in each project
    #[arg(long, value_name = "KIND|DIR")]
    depth_maps: String,
    /// File to write the settings to; it must not exist [default: print only]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Backend that made the depth maps [default: by their format]
    #[arg(long, value_name = "NAME")]
    backend: Option<String>,
    /// Threads to use; the result is the same for any number [default: all]
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
    /// Name of the backend that made the maps.
    backend: String,
    plan: Plan,
    maps: depthmaps::DepthMapSet,
    clusters: Vec<ViewCluster>,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    if let Some(out) = &arguments.out {
        output::refuse_to_replace(out)?;
    }
    use_threads(arguments.threads);
    let progress = ProgressDisplay::new(arguments.quiet);
    let prepared: Vec<Prepared> = arguments
        .projects
        .iter()
        .map(|root| prepare(arguments, root, &progress))
        .collect::<Result<_, _>>()?;
    let backend = backends::by_name(one_backend(&prepared)?)?;
    let lessons: Vec<Lesson> = prepared.iter().map(lesson).collect();
    let numbers = &backend.planning;
    let before = Numbers {
        min_matches: numbers.confidence.min_matches,
        photometric: numbers.photometric,
    };
    let fitted = learn::train(&lessons, before, &progress)?;
    let settings = settings(&fitted, backend.name);
    if let Some(out) = &arguments.out {
        output::replace(out, settings.as_bytes(), &Disk::REAL)?;
    }
    progress.finish();
    match arguments.format {
        Format::Json => print_json(&fitted),
        Format::Text if arguments.quiet => Ok(()),
        Format::Text => print(text(arguments, &fitted, &settings)),
    }
}

/// Returns the folder of depth maps of a project; `named` is a kind, or a folder as the user typed
/// it.
///
/// # Errors
/// If a link of the project leads from it to somewhere else.
fn folder_of_maps(project: &Project, named: &str) -> Result<PathBuf, Failure> {
    let dense = project.dense_workspace.as_deref();
    if let Some(folder) = depthmaps::folder_of(&project.root, dense, named) {
        return Ok(folder);
    }
    let folder = project.root.join(named);
    output::refuse_to_leave(&project.root, &folder)?;
    Ok(folder)
}

/// Plans the project as its written plan was made, else by its settings, with the confidence that
/// is fitted.
fn prepare(
    arguments: &Arguments,
    root: &Path,
    progress: &ProgressDisplay,
) -> Result<Prepared, Failure> {
    let (project, mut settings, written) = match WrittenPlan::read(root) {
        Ok(written) => {
            let ranked = |cluster: &RankedCluster| ViewCluster {
                key: cluster.key,
                partners: cluster.partners.clone(),
            };
            let clusters = written.clusters.iter().map(ranked).collect();
            (written.project, written.settings, clusters)
        }
        Err(WrittenPlanError::Io { source, .. }) if source.kind() == ErrorKind::NotFound => {
            let project = Project::open_or_planned(root, None)?;
            let settings = config::load(Some(&project), CommandLineSettings::default())?.settings;
            (
                project.with_images(settings.images.as_deref()),
                settings,
                Vec::new(),
            )
        }
        Err(error) => return Err(error.into()),
    };
    let scene = project.read_scene()?;
    let folder = folder_of_maps(&project, &arguments.depth_maps)?;
    let found = depthmaps::find(&folder, &scene)?.into_complete()?;
    let backend = backend(arguments, &found.maps[0].format);
    settings.confidence.source = ConfidenceSource::Photometric;
    // That of the maps, whichever the plan was for.
    settings.backends = vec![backend.clone()];
    let plan = Plan::from_scene(
        &project,
        scene,
        &settings,
        &planned_for(&project, &settings)?,
        Timings::start(),
        progress,
    )?;
    let clusters = evaluate::tried(&folder, &found.maps, &plan.stages.scene, &written)?;
    Ok(Prepared {
        backend,
        plan,
        maps: found,
        clusters,
    })
}

/// Numbers are those of one backend.
fn one_backend(prepared: &[Prepared]) -> Result<&str, MixedBackends> {
    let first = &prepared[0].backend;
    match prepared.iter().find(|other| other.backend != *first) {
        None => Ok(first),
        Some(other) => Err(MixedBackends([first.clone(), other.backend.clone()])),
    }
}

#[derive(Debug, thiserror::Error)]
#[error("the depth maps are of two backends, {} and {}", .0[0], .0[1])]
struct MixedBackends([String; 2]);

impl Hint for MixedBackends {
    fn hint(&self) -> Option<Advice> {
        Some("train on the projects of one backend, or name it with --backend".into())
    }
}

fn lesson(prepared: &Prepared) -> Lesson<'_> {
    Lesson {
        model: prepared.plan.stages.model(),
        clusters: prepared.clusters.clone(),
        maps: prepared.maps.maps.clone(),
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
        DepthMapFormat::MicMac => "micmac",
        DepthMapFormat::Npy => "sgm",
    };
    arguments
        .backend
        .clone()
        .unwrap_or_else(|| by_format.into())
}

/// The fitted numbers as a settings file.
fn settings(fitted: &Fitted, backend: &str) -> String {
    let Numbers {
        min_matches,
        photometric,
    } = fitted.numbers;
    let maps = fitted.depth_maps;
    format!(
        "# Fitted to {maps} depth map{} of {backend} by viewrank train.\nconfidence.agree = {}\nconfidence.differ = {}\n\
         confidence.full_agreement = {}\nconfidence.min_matches = {min_matches}\n",
        if maps == 1 { "" } else { "s" },
        photometric.agree,
        photometric.differ,
        photometric.full_agreement,
    )
}

fn text(arguments: &Arguments, fitted: &Fitted, settings: &str) -> Vec<String> {
    let scores = |name: &str, s: &learn::Scores| {
        format!(
            "{name:<28} {:>10.3} {:>12.3} {:>18.3}",
            s.auc, s.brier, s.calibration_error
        )
    };
    let left_out = if arguments.projects.len() > 1 {
        "fitted to the other scenes"
    } else {
        "fitted to the other half"
    };
    let table = [
        format!(
            "{:<28} {:>10} {:>12} {:>18}",
            "", "ROC area", "Brier score", "calibration error"
        ),
        scores("numbers of the backend", &fitted.before),
        scores(left_out, &fitted.after),
    ];
    let project = &arguments.projects[0];
    let settings_of = match &arguments.out {
        Some(out) => format!("{}, for the top of viewrank.toml:", out.display()),
        None => "For the top of viewrank.toml:".into(),
    };
    let what = format!(
        "{} triangles of {} depth maps. How well they are predicted by",
        fitted.triangles, fitted.depth_maps
    );
    let mut lines = vec![what, String::new()];
    lines.extend(table);
    lines.extend([String::new(), settings_of, String::new()]);
    lines.extend(settings.lines().map(String::from));
    lines.extend([
        String::new(),
        format!("Next: viewrank plan {}", command_path(project)),
    ]);
    lines
}
