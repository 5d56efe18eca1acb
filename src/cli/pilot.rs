//! `viewrank pilot`: prepares small depth maps of all views by the program itself, which a plan
//! ranks by in place of viewrank's own (method 5.9).

use std::path::{Path, PathBuf};

use clap::Args;

use super::{
    Exit, Failure, arguments, config, next, print, progress::ProgressDisplay, use_threads, warn,
};
use crate::{
    apps::planning,
    backends,
    base::shell::command_path,
    config::{CommandLineSettings, CutSettings, PilotSettings, Settings, Share},
    decision::Matcher,
    io::project::Project,
    model::{camera::Camera, cluster::MapScale, scene::Scene},
    show::files::files_of_same_model,
};

/// Size of the pilot's maps over that of the program's own.
const SMALLER: f64 = 8.0;
/// But no map's longer side is below this, pixels.
const LEAST_SIDE: f64 = 160.0;

/// Prepare small depth maps of all views, made by the MVS program itself, for a plan to rank by.
///
/// Writes the program's input files at an eighth of its size (never below 160 pixels) to
/// PROJECT/viewrank/pilot. For programs that succeed elsewhere than viewrank's own thumbnails do,
/// which a plan ranks by otherwise; with OpenMVS, plans were no better for it (docs/benchmarks.md).
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = arguments::project())]
    project: PathBuf,

    /// Program that matches [default: as for viewrank plan]
    #[arg(long, value_name = "NAME")]
    backend: Option<String>,
    /// Write to DIR/viewrank instead of PROJECT/viewrank/pilot/viewrank
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Threads to use [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// No progress and no summary; warnings and errors only
    #[arg(long, short)]
    quiet: bool,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    use_threads(arguments.threads);
    let project = Project::open_or_planned(&arguments.project, None)?;
    let root = project.as_argument();
    let own = || project.output_folder().join("pilot");
    let out = arguments.out.clone().unwrap_or_else(own);
    let project = project.with_home(&out);
    let mut typed = CommandLineSettings::default();
    let named = arguments.backend.as_ref().map(|name| vec![name.clone()]);
    typed.set("--backend", "backends", named);
    let settings = config::load(Some(&project), typed)?.settings;
    let project = project.with_images(settings.images.as_deref());
    let scene = project.read_scene()?;
    let matcher = backends::planned_for(&project, &settings)?;
    refuse_impossible(&scene, &matcher)?;
    refuse_other_plan(&project, arguments)?;
    let settings = small(settings, &scene, &matcher);
    let progress = ProgressDisplay::new(arguments.quiet);
    let plan = planning::plan_scene(&project, scene, &settings, &progress)?;
    let files = files_of_same_model(&plan, &project)?;
    let uncached = files.write(&project.disk())?;
    progress.finish();
    plan.warnings
        .iter()
        .chain(&uncached)
        .for_each(|text| warn(text));
    if arguments.quiet {
        return Ok(());
    }
    let side = longest_side(&plan.stages.scene) * settings.image_scale();
    let folder = command_path(&project.home);
    let again = |other: &str| format!("viewrank plan {other} --backend {}", matcher.name);
    print([
        format!(
            "{} small depth maps ({side:.0} pixels) of {}, most useful first.",
            plan.decision.cut.clusters, matcher.name
        ),
        format!(
            "Next: {}",
            next::next(&project, &plan, &files, None, &again)
        ),
        format!(
            "Then: viewrank plan {root} --backend {} --pilot {folder}",
            matcher.name
        ),
    ])
}

/// Fails where the program cannot make small maps.
fn refuse_impossible(scene: &Scene, matcher: &Matcher) -> Result<(), Failure> {
    if !matcher.makes_maps {
        let message = format!("no pilot for {}: it makes no depth maps", matcher.name);
        let hint = "plan without one: viewrank plan";
        return Err(Failure::new(Exit::Usage, message, Some(hint.into())));
    }
    let takes_distorted =
        backends::by_name(matcher.name).is_ok_and(|backend| backend.takes_distorted);
    let mut cameras = scene.view_indices().map(|view| scene.camera_of(view));
    if takes_distorted || cameras.all(Camera::is_pinhole) {
        return Ok(());
    }
    let message = format!("{} needs undistorted images", matcher.name);
    let hint = "undistort them (viewrank undistort), and name the folder that it makes";
    Err(Failure::new(Exit::Failed, message, Some(hint.into())))
}

/// Fails if `--out` has a plan that is no pilot, which would be lost.
fn refuse_other_plan(project: &Project, arguments: &Arguments) -> Result<(), Failure> {
    let is_pilot = |out: &Path| out.file_name().is_some_and(|name| name == "pilot");
    let plan = project.output_folder().join("manifest.json");
    match &arguments.out {
        Some(out) if plan.exists() && !is_pilot(out) => Err(Failure::new(
            Exit::Usage,
            format!("{} has a plan already", out.display()),
            Some("name a folder of its own for the pilot".into()),
        )),
        _ => Ok(()),
    }
}

/// Returns the settings of a plan of all views at a small size.
fn small(settings: Settings, scene: &Scene, matcher: &Matcher) -> Settings {
    let own = settings.image_scale;
    let own = own.unwrap_or_else(|| matcher.image_scale(scene));
    let least = LEAST_SIDE / longest_side(scene).max(1.0);
    let mut small = Settings {
        // Never above the program's own size, even if that is below the least side.
        image_scale: Some((own / SMALLER).max(least).min(own)),
        backends: vec![matcher.name.into()],
        cut: CutSettings {
            target: Some(Share(1.0)),
            ..CutSettings::default()
        },
        pilot: PilotSettings::default(),
        region: None,
        ..settings
    };
    small.ranking.scales = vec![MapScale::Full];
    small
}

fn longest_side(scene: &Scene) -> f64 {
    let cameras = scene.view_indices().map(|view| scene.camera_of(view));
    let sides = cameras.map(|camera| camera.width.max(camera.height));
    sides.max().map_or(0.0, f64::from)
}
