//! `viewrank plan`: reads a sparse model, ranks its view clusters, writes the plan.

use std::{
    io::ErrorKind,
    path::{Path, PathBuf},
};

use crate::{
    apps::{
        dispatch::Dispatch,
        doctor::counted,
        planning,
        replan::{EarlierPlan, MapFolder, replan},
        report::{DepthMapFolders, MissedRegion, own_folder_of_maps},
    },
    backends::{self, Backend, Choice, KnownMaps, known_maps},
    base::{
        advice::on_command_line,
        error::{Advice, Hint},
        paths,
        progress::{Stage, Watcher},
        shell::{command_path, shown_path},
    },
    config::{CommandLineSettings, Settings, TypedSetting},
    io::{
        depthmaps::{self, DepthMapError},
        output::{self, Disk, FileSet, OutputError},
        ply,
        project::Project,
    },
    method::{region::RegionError, surface::SurfaceError},
    plan::{self, Plan, PlanError},
    show::{
        files::{PlanFiles, files_of_same_model},
        manifest::{
            WrittenPlanError, planned_backend, planned_backends, planned_model, planned_options,
            planned_test_every, warnings_with,
        },
        tables,
    },
};
use clap::Args;

use super::{
    Exit, Failure, Format, arguments, config, next, note, print, print_json, print_sentences,
    progress::ProgressDisplay,
    summary::{Asked, Summary},
    use_threads, warn,
};

/// Rank the view clusters of a project and write the plan to PROJECT/viewrank.
///
/// Where there are images, all views are first matched in thumbnails, and the plan ranks by what
/// agreed.
///
/// PROJECT is a COLMAP project (sparse/, images/), a dense workspace (sparse/, images/, stereo/),
/// the folder of a sparse model, or a model (or its folder) of Bundler, VisualSFM (.nvm), OpenMVG,
/// OpenSfM, OpenDroneMap, AliceVision, OpenMVS (.mvs), SURE (.ori), MVE (synth_0.out), MicMac
/// (Ori-...), Metashape (cameras.xml), ContextCapture (BlocksExchange XML) or nerfstudio
/// (transforms.json). Where the program needs undistorted images, and a dense workspace of the
/// project has them, that is planned. Lengths are in model units; they may be typed in metres where
/// the model has a place on earth or viewrank.toml says units = "metric".
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = super::arguments::project())]
    project: PathBuf,

    /// Matching partners per key view; more give more image pairs to match [default: 5]
    #[arg(short, value_name = "N", help_heading = "Selection")]
    k: Option<String>,
    /// Stop after N view clusters (or images), or after P % of the registered views (of images, of
    /// those that can be chosen; with --scales, of the work of all)
    #[arg(long, value_name = "N|P%", help_heading = "Selection")]
    budget: Option<String>,
    /// Stop at P % of what all view clusters together reach [default: 90%, if no other limit is
    /// set]
    #[arg(long, value_name = "P%", help_heading = "Selection")]
    target: Option<String>,
    /// Keep every N-th image by name, from the first, apart for tests: neither chosen nor drawn; 0:
    /// none, whatever the model says (splat, images)
    #[arg(long, value_name = "N", help_heading = "Selection")]
    test_every: Option<String>,
    /// Stop before the forecast time of matching exceeds T, such as 2h or 90min
    #[arg(long, value_name = "T", help_heading = "Selection")]
    time: Option<String>,
    /// Stop before the forecast number of points exceeds N, such as 50M
    #[arg(long, value_name = "N", help_heading = "Selection")]
    points: Option<String>,

    /// Plan for this part of the scene: a file of GeoJSON polygons or a closed PLY mesh,
    /// a box in the frame of the model, or auto, the part that the photographs show most densely
    #[arg(
        long,
        value_name = "FILE|X0,Y0,Z0,X1,Y1,Z1|auto",
        allow_hyphen_values = true,
        help_heading = "Target"
    )]
    region: Option<String>,
    /// Wanted ground sampling distance, model units per pixel; with units = "metric" also as 2cm
    /// [default: from the model]
    #[arg(long, value_name = "L", help_heading = "Target")]
    gsd: Option<String>,
    /// Wanted accuracy of a point, as --gsd [default: as --gsd]
    #[arg(long, value_name = "L", help_heading = "Target")]
    accuracy: Option<String>,

    /// Sizes that a key view may be matched at, over the size of the images: 1 or 1,0.5; with two,
    /// each gets one such that the plan gives most for its work [default: 1]
    #[arg(long, value_name = "S,...", value_delimiter = ',', value_parser = super::arguments::scale, help_heading = "Method")]
    scales: Option<Vec<f64>>,
    /// Choice of partners: sampled (the paper) or search [default: search]
    #[arg(long, value_name = "METHOD", value_parser = ["sampled", "search"], help_heading = "Method")]
    partners: Option<String>,
    /// What predicts success: photometric (agreement of the pictures), geometric, none or auto
    /// [default: auto, which is photometric where there are images]
    #[arg(long, value_name = "SOURCE", value_parser = ["photometric", "geometric", "none", "auto"], help_heading = "Method")]
    confidence: Option<String>,
    /// Surface: 3d, terrain (nadir flights) or auto [default: auto]
    #[arg(long, value_name = "KIND", value_parser = ["3d", "terrain", "auto"], help_heading = "Method")]
    surface: Option<String>,
    /// Up direction of the terrain surface [default: from the cameras]
    #[arg(long, value_name = "X,Y,Z", value_parser = direction, allow_hyphen_values = true, help_heading = "Method")]
    up: Option<[f64; 3]>,
    /// Use the surface in this PLY file
    #[arg(long, value_name = "FILE", help_heading = "Method")]
    mesh: Option<PathBuf>,
    /// Use the mesh as it is, neither simplified nor refined
    #[arg(long, requires = "mesh", help_heading = "Method")]
    mesh_as_is: bool,
    #[arg(
        long,
        value_name = "NAME,...",
        value_delimiter = ',',
        help = super::backends::option_help(
            "Write for these backends; the plan is made for the first",
            "those of the plan before, else as the project is set up, else what is installed",
        ),
        help_heading = "Method"
    )]
    backend: Option<Vec<String>>,
    /// Sub-model to plan for [default: the one with most images]
    #[arg(long, value_name = "N", help_heading = "Method")]
    model: Option<String>,
    /// Folder to which the image names of the model are relative [default: where they are found]
    #[arg(long, value_name = "DIR", help_heading = "Method")]
    images: Option<PathBuf>,
    /// Don't place the model on earth by the GPS positions in its images
    #[arg(long, help_heading = "Method")]
    no_gps: bool,
    /// Rank by these small depth maps of the backend, which viewrank pilot prepares, in place of
    /// viewrank's own
    #[arg(long, value_name = "DIR", help_heading = "Method")]
    pilot: Option<PathBuf>,
    /// Keep the finished depth maps in this folder, made for an earlier plan of PROJECT, and
    /// re-rank the rest by their measured quality [default: where the backend writes them, if the
    /// plan before was for it]
    #[arg(long, value_name = "DIR", value_parser = super::arguments::folder(), help_heading = "Method")]
    finished: Option<PathBuf>,
    /// Seed of all random choices [default: 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(0..), help_heading = "Method")]
    seed: Option<i64>,
    /// Memory limit, such as 8G; larger surfaces are built in tiles, larger tables kept on disk
    /// [default: no limit]
    #[arg(long, value_name = "SIZE", help_heading = "Method")]
    max_memory: Option<String>,
    /// Threads to use; the plan is the same for any number [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024), help_heading = "Method")]
    threads: Option<u16>,

    /// Write to DIR/viewrank and nothing into PROJECT; DIR then takes the place of PROJECT in later
    /// commands
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    out: Option<PathBuf>,
    /// Also write all tables of the plan as NumPy files
    #[arg(
        long,
        value_name = "DIR",
        conflicts_with = "dry_run",
        help_heading = "Output"
    )]
    dump_tables: Option<PathBuf>,
    /// Also write the bare surface as a PLY file
    #[arg(
        long,
        value_name = "FILE",
        conflicts_with = "dry_run",
        help_heading = "Output"
    )]
    dump_surface: Option<PathBuf>,
    /// Also write the page of viewrank report
    #[arg(long, conflicts_with = "dry_run", help_heading = "Output")]
    report: bool,
    /// Plan, but write nothing
    #[arg(long, help_heading = "Output")]
    dry_run: bool,
    /// No progress and no summary; warnings and errors only
    #[arg(long, short, help_heading = "Output")]
    quiet: bool,
    /// A summary with all shares and bounds
    #[arg(long, conflicts_with = "quiet", help_heading = "Output")]
    verbose: bool,
    /// Format of the summary on stdout
    #[arg(long, value_enum, default_value_t, help_heading = "Output")]
    format: Format,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    use_threads(arguments.threads);
    if let Some(path) = &arguments.dump_surface {
        output::refuse_to_replace(path)?;
    }
    let Input {
        project,
        settings,
        keeps_backend,
        dropped_region,
    } = Input::read(arguments)?;
    if !arguments.dry_run {
        // A run that is at work computes the maps of the plan that this one would replace.
        Dispatch::refuse_if_at_work(&project)?;
        refuse_unwritable(arguments, &project)?;
    }
    let progress = ProgressDisplay::new(arguments.quiet);
    let mut plan = planned(arguments, &project, &settings, &progress)?;
    let files = files_of_same_model(&plan, &project)
        // Nothing else would print them.
        .inspect_err(|_| plan.warnings.iter().for_each(|warning| warn(warning)))?;
    if !arguments.dry_run {
        write(arguments, &project, &plan, &files, &progress)?;
    }
    let page = if arguments.report {
        Some(page(&project, &mut plan, &files, &progress)?)
    } else {
        None
    };
    progress.finish();
    let asked = Asked {
        is_survey: settings.region.is_some() || settings.target.gsd.is_some(),
        keeps_backend,
        dropped_region,
        page,
    };
    report(arguments, &project, &plan, &files, asked)?;
    match &files.not_exported[..] {
        missing if arguments.backend.is_some() && !missing.is_empty() => {
            // The plan itself is written and printed, but a script needs the export that it asked
            // for.
            Err(Failure::from(ExportFailure(missing.to_vec())).behind_result())
        }
        _ => Ok(()),
    }
}

/// Project and settings to plan, with what they take over from the previous plan.
struct Input {
    project: Project,
    settings: Settings,
    keeps_backend: bool,
    dropped_region: Option<TypedSetting>,
}

impl Input {
    fn read(arguments: &Arguments) -> Result<Self, Failure> {
        let project = Project::open_or_planned(&arguments.project, arguments.model.as_deref())?;
        let settings = config::load(Some(&project), arguments.typed())?.settings;
        let project = project.with_images(settings.images.as_deref());
        // The plan before is where this one is written.
        let at_home = match &arguments.out {
            Some(out) => &project.clone().with_home(out),
            None => &project,
        };
        let kept = kept_backends(at_home, &settings)?;
        let dropped_region = planned_options(&at_home.home)
            .into_iter()
            .find(|option| option.key == "region" && settings.region.is_none());
        let mut settings = Settings {
            backends: match &kept {
                Some(kept) => kept.iter().map(|backend| backend.name.into()).collect(),
                None => settings.backends,
            },
            ..settings
        };
        settings.test_every = kept_test_every(&at_home.home, &settings);
        let (project, settings) = matchable(arguments, project, settings)?;
        let project = match &arguments.out {
            Some(out) => {
                refuse_nested(out)?;
                project.with_home(out)
            }
            None => project,
        };
        refuse_missing_images(&project)?;
        refuse_other_plan(&project)?;
        Ok(Self {
            project,
            settings,
            keeps_backend: kept.is_some(),
            dropped_region,
        })
    }
}

/// Returns the plan, around the depth maps that are finished.
fn planned(
    arguments: &Arguments,
    project: &Project,
    settings: &Settings,
    progress: &ProgressDisplay,
) -> Result<Plan, Failure> {
    let plan = planning::plan(project, settings, progress)
        .map_err(|error| refused(error, arguments, project, settings))?;
    if !arguments.dry_run {
        // Before the earlier plan is read, which a killed run may have left half written.
        output::recover(&project.home, &project.disk())?;
    }
    let finished = match &arguments.finished {
        // Whoever names a folder vouches for its maps, unless they are another program's.
        Some(folder) => {
            let known = not_of_others(&plan, project, folder);
            Some((folder.clone(), earlier(project)?, known))
        }
        None => own_maps(&plan, project),
    };
    let Some((folder, earlier, known)) = finished else {
        return Ok(plan);
    };
    let plan = around_finished(plan, &folder, &earlier, known, progress)?;
    warn_of_other_folder(&plan, project, &folder);
    Ok(plan)
}

/// Returns what tells depth maps in a folder from those that other programs than the plan's have
/// made in the project, which do not count; `None`, with none of these. Names them.
fn not_of_others(plan: &Plan, project: &Project, folder: &Path) -> Option<KnownMaps> {
    let backend = plan.stages.backend;
    let others = depthmaps::folders_of_others(&project.home, backend);
    let others: Vec<PathBuf> = others.iter().map(|other| paths::real(other)).collect();
    let named = paths::real(folder);
    let looked_at = others.iter().filter_map(|other| {
        if named.starts_with(other) {
            Some(&named)
        } else {
            Some(other).filter(|other| other.starts_with(&named))
        }
    });
    let maps = |folder: &PathBuf| depthmaps::list(folder, &plan.stages.scene);
    let maps = looked_at.filter_map(|folder| Some(maps(folder).ok()?.maps.len()));
    match maps.sum::<usize>() {
        0 => return None,
        n => warn(&format!(
            "not counted for this plan for {backend}: {} in {}, since another program has made them",
            counted(n, "depth map"),
            shown_path(folder)
        )),
    }
    Some(Box::new(move |map| {
        let map = paths::real(map);
        !others.iter().any(|other| map.starts_with(other))
    }))
}

/// Says what to do with finished depth maps that are not where the plan's program writes its own:
/// nothing else counts them there.
fn warn_of_other_folder(plan: &Plan, project: &Project, folder: &Path) {
    let place = |folder: &Path| folder.canonicalize().ok();
    let own = own_folder_of_maps(plan, project);
    let finished = plan.decision.finished;
    if let Some(own) = own.filter(|own| finished > 0 && place(own) != place(folder)) {
        warn(&format!(
            "status, run, evaluate and the report count depth maps in {} alone: copy {} there from {}, or viewrank run makes them again",
            shown_path(&own),
            counted(finished, "finished depth map"),
            shown_path(folder)
        ));
    }
}

/// Returns the backends of the plan in the project, the one that it is for first, if none are named
/// and the default is not the same: its depth maps would be lost, and its exports outdated.
pub fn kept_backends(
    project: &Project,
    settings: &Settings,
) -> Result<Option<Vec<&'static Backend>>, Failure> {
    let (backend, choice) = backends::chosen(project, settings)?;
    let Ok(kept) = backends::by_names(&planned_backends(project)) else {
        return Ok(None);
    };
    let is_other = kept.iter().any(|planned| planned.name != backend.name);
    Ok((is_other && choice != Choice::Named).then_some(kept))
}

/// Returns the project that the backend can match, with the settings for it: the workspace of
/// undistorted images, where it needs one.
fn matchable(
    arguments: &Arguments,
    project: Project,
    settings: Settings,
) -> Result<(Project, Settings), Failure> {
    let (backend, _) = backends::chosen(&project, &settings)?;
    let Some(workspace) = planning::undistorted_workspace(&project, backend)? else {
        return Ok((project, settings));
    };
    if !arguments.quiet {
        let place = workspace.root.display();
        note(&format!(
            "{} needs undistorted images: planning {place} with the images there",
            backend.name
        ));
        let others = project.other_workspaces();
        others.iter().for_each(|said| note(said));
    }
    // It has its images beside its model.
    let images = None;
    Ok((workspace, Settings { images, ..settings }))
}

/// Fails, before the long computation, if what the plan is to be written into cannot be written.
fn refuse_unwritable(arguments: &Arguments, project: &Project) -> Result<(), Failure> {
    output::refuse_unwritable(&project.output_folder()).map_err(|error| {
        let root = command_path(&project.root);
        elsewhere(error, project.is_elsewhere(), "plan", &root)
    })?;
    let dumps = [
        arguments.dump_tables.as_deref(),
        arguments.dump_surface.as_deref().and_then(Path::parent),
    ];
    dumps
        .into_iter()
        .flatten()
        .try_for_each(output::refuse_unwritable)?;
    Ok(())
}

/// Returns which images are kept apart for tests: as in the plan before unless something else is
/// asked for, since images that have trained are no tests.
fn kept_test_every(home: &Path, settings: &Settings) -> Option<u32> {
    let kept = || {
        let takes_images =
            |name: &String| backends::by_name(name).is_ok_and(|backend| !backend.makes_maps());
        let every = planned_test_every(home)?;
        if !settings.backends.iter().all(takes_images) {
            return None;
        }
        note(&format!(
            "images are kept apart for tests as in the plan before (--test-every {every}; 0 plans with all)"
        ));
        Some(every)
    };
    settings.test_every.or_else(kept)
}

/// Returns the folder of the depth maps that were made for the plan that this one replaces, with
/// that plan and a test for its maps: without them, nobody would know their partners, or that their
/// views have moved. Warns of maps whose plan is lost.
fn own_maps(plan: &Plan, project: &Project) -> Option<(PathBuf, EarlierPlan, Option<KnownMaps>)> {
    let is_same = planned_backend(project).is_some_and(|name| name == plan.stages.backend);
    let folder = own_folder_of_maps(plan, project).filter(|folder| folder.is_dir())?;
    if !(plan.stages.makes_maps && is_same) {
        return None;
    }
    let lost = match depthmaps::find(&folder, &plan.stages.scene) {
        Ok(_) => match earlier(project) {
            Ok(earlier) => {
                let known = known_maps(plan.stages.backend, &folder);
                return Some((folder, earlier, Some(known)));
            }
            Err(error) => error.to_string(),
        },
        Err(DepthMapError::None(_)) => return None,
        Err(error) => error.to_string(),
    };
    let folder = folder.display();
    warn(&format!(
        "planned without the depth maps in {folder}: {lost}"
    ));
    None
}

fn around_finished(
    plan: Plan,
    folder: &Path,
    earlier: &EarlierPlan,
    known: Option<KnownMaps>,
    progress: &ProgressDisplay,
) -> Result<Plan, Failure> {
    let maps = MapFolder {
        folder,
        ready: &|_| true,
        known: &|map| known.as_ref().is_none_or(|known| known(map)),
    };
    let (plan, ..) = replan(plan, earlier, &maps, progress)?;
    if plan.decision.finished == 0 {
        warn(&format!(
            "no depth map in {} fits the plan; planning without finished ones",
            folder.display()
        ));
    }
    Ok(plan)
}

/// Requested exports that were not written.
#[derive(Debug, thiserror::Error)]
#[error("the plan is complete, but {}", .0.join("; "))]
struct ExportFailure(Vec<String>);

impl Hint for ExportFailure {
    fn hint(&self) -> Option<Advice> {
        None
    }
}

/// Fails if `--out` is the folder of a plan itself, into which another one would be nested.
fn refuse_nested(out: &Path) -> Result<(), Failure> {
    let out = std::path::absolute(out).unwrap_or(out.into());
    match (out.file_name(), out.parent()) {
        (Some(name), Some(above)) if name == "viewrank" && out.join("manifest.json").exists() => {
            let what = format!(
                "{}: a plan is written into a folder viewrank of --out, and this is one",
                out.display()
            );
            Err(Failure::new(
                Exit::Usage,
                what,
                format!("give the folder above: --out {}", command_path(above)),
            ))
        }
        _ => Ok(()),
    }
}

/// Fails if the folder of `--images` does not exist.
fn refuse_missing_images(project: &Project) -> Result<(), Failure> {
    match &project.images {
        Some(images) if !images.is_dir() => Err(Failure::new(
            Exit::Usage,
            format!("{}: no such folder of images", images.display()),
            None,
        )),
        _ => Ok(()),
    }
}

/// Name of the set of images to take of a region without surface, and their folder.
const MISSED_SET: &str = "missed-region";
const MISSED: &str = "viewrank/missed-region";

/// Adds to the error of a plan what else is known; of a region without surface, plans the images to
/// take of it.
fn refused(
    error: PlanError,
    arguments: &Arguments,
    project: &Project,
    settings: &Settings,
) -> Failure {
    if matches!(error, PlanError::Region(_) | PlanError::RegionFile(_)) {
        let unused = plan::unused_positions(project, settings);
        unused.iter().for_each(|said| warn(said));
    }
    let found = match &error {
        PlanError::Region(region) if region.is_of_bare_ground() => {
            let found = MissedRegion::find(project, settings);
            // A box may be above or below the surface, which photographs of its ground show.
            let is_box = matches!(region, RegionError::OutsideBox { .. });
            found.filter(|missed| !is_box || missed.waypoints > 0)
        }
        _ => None,
    };
    let Some(missed) = found else {
        return far_off(error, project, settings);
    };
    missed.cautions.iter().for_each(|caution| warn(caution));
    let what = format!("{} No depth map can be planned: {error}", missed.headline());
    let mut files = FileSet::new(&project.home, MISSED_SET);
    for (name, text) in missed.files {
        let name = name.strip_prefix("flight/").unwrap_or(name);
        files.add_text(format!("{MISSED}/{name}"), text);
    }
    let hint = match missed.waypoints {
        0 => None,
        _ if arguments.dry_run => None,
        images => match files.write(&project.disk()) {
            Ok(_) => Some(format!(
                "take the {images} images that are planned in {}, or draw the region on over a part of the surface",
                shown_path(&project.home.join(MISSED))
            )),
            Err(error) => {
                warn(&error.to_string());
                None
            }
        },
    };
    let own = || error.hint().map(|hint| on_command_line(&hint));
    Failure::new(Exit::Failed, what, hint.or_else(own))
}

/// Adds the resolution of the model to the error of a surface for which a far coarser or finer one
/// was asked. If none was asked for, adds what else may be the cause.
fn far_off(error: PlanError, project: &Project, settings: &Settings) -> Failure {
    if let (PlanError::Surface(SurfaceError::Refine(_)), None) = (&error, settings.target.gsd) {
        let hint = format!(
            "{}; if such a fine one was never meant, look for a wrong camera: viewrank doctor {}",
            error.hint().unwrap_or_default(),
            command_path(&project.root)
        );
        return Failure::new(Exit::Failed, error.to_string(), hint);
    }
    let (PlanError::Surface(_), Some(gsd), Ok(scene)) =
        (&error, settings.target.gsd, project.read_scene())
    else {
        return error.into();
    };
    match scene.median_gsd() {
        Some(own) if !(own / FAR_OFF..own * FAR_OFF).contains(&gsd) => {
            let place = plan::georeference(project, &scene, &settings.frame);
            let metres = plan::metres(settings.units, &place);
            let [wanted, own] = [gsd, own].map(|gsd| plan::length_in_words(gsd, metres));
            let hint = format!(
                "--gsd asks for {wanted} per pixel, far from the images' own {own}: give one nearer to that, or leave it out"
            );
            Failure::new(Exit::Failed, error.to_string(), hint)
        }
        _ => error.into(),
    }
}

/// Ratio of a wanted to the model's own resolution that is probably a mistake.
const FAR_OFF: f64 = 20.0;

/// Adds a way around to the error of an unwritable folder, unless the user chose it.
pub fn elsewhere(error: OutputError, is_named: bool, command: &str, project: &str) -> Failure {
    let is_denied = matches!(&error, OutputError::Denied { .. })
        || matches!(&error, OutputError::Io { source, .. } if source.kind() == ErrorKind::ReadOnlyFilesystem);
    if is_denied && !is_named {
        let hint = format!("write elsewhere: viewrank {command} {project} --out DIR");
        Failure::new(Exit::Failed, error.to_string(), hint)
    } else {
        error.into()
    }
}

impl Arguments {
    /// Command-line options as settings.
    fn typed(&self) -> CommandLineSettings {
        let mut typed = CommandLineSettings::default();
        let path = |path: &PathBuf| arguments::absolute(path);
        let k = self.k.as_deref();
        typed.set("-k", "partners.k", k.map(arguments::number));
        typed.set("--budget", "cut.budget", self.budget.clone());
        typed.set("--target", "cut.target", self.target.clone());
        typed.set("--time", "cut.time", self.time.clone());
        let test_every = self.test_every.as_deref().map(arguments::number);
        typed.set("--test-every", "test_every", test_every);
        typed.set("--points", "cut.points", self.points.clone());
        let region = self.region.as_deref();
        typed.set("--region", "region", region.map(arguments::region));
        typed.set("--gsd", "target.gsd", self.gsd.clone());
        typed.set("--accuracy", "target.accuracy", self.accuracy.clone());
        typed.set("--scales", "ranking.scales", self.scales.clone());
        typed.set("--partners", "partners.method", self.partners.clone());
        typed.set("--confidence", "confidence.source", self.confidence.clone());
        typed.set("--surface", "surface.kind", self.surface.clone());
        typed.set("--up", "surface.up", self.up.map(Vec::from));
        typed.set("--mesh", "surface.mesh", self.mesh.as_ref().map(path));
        typed.set(
            "--mesh-as-is",
            "surface.mesh_as_is",
            self.mesh_as_is.then_some(true),
        );
        typed.set("--images", "images", self.images.as_ref().map(path));
        typed.set("--pilot", "pilot.maps", self.pilot.as_ref().map(path));
        typed.set("--no-gps", "frame.gps", self.no_gps.then_some(false));
        typed.set("--backend", "backends", self.backend.clone());
        typed.set("--seed", "seed", self.seed);
        typed.set("--max-memory", "max_memory", self.max_memory.clone());
        typed
    }

    /// Returns the `viewrank run` that makes the same plan; `None` if it lacks an option that was
    /// typed, or has one backend where more were. `maps_of_run`: the folder of its depth maps.
    fn as_run(&self, maps_of_run: &Path) -> Option<String> {
        let place = |path: &Path| path.canonicalize().ok();
        let other_maps = self
            .finished
            .as_ref()
            .is_some_and(|maps| place(maps) != place(maps_of_run));
        let is_elsewhere = self.model.is_some() || self.out.is_some() || other_maps;
        let backends = self.backend.as_deref().unwrap_or_default();
        let options = [
            ("--backend", backends.first().cloned()),
            ("--target", self.target.clone()),
            ("--budget", self.budget.clone()),
            ("-k", self.k.clone()),
            ("--scales", next::scales(self.scales.as_deref())),
            ("--region", self.region.clone()),
            ("--gsd", self.gsd.clone()),
            (
                "--images",
                self.images.as_ref().map(|path| path.display().to_string()),
            ),
        ];
        let has_all = self
            .typed()
            .are_among(&options.each_ref().map(|(name, _)| *name));
        let is_possible = has_all && !is_elsewhere && backends.len() <= 1;
        is_possible.then(|| {
            next::with_options(
                format!("viewrank run {}", command_path(&self.project)),
                options,
            )
        })
    }
}

/// A folder holds one plan; that of another sub-model is not overwritten.
fn refuse_other_plan(project: &Project) -> Result<(), Failure> {
    let planned = planned_model(project).map(|model| project.root.join(model));
    let other = project
        .other_models
        .iter()
        .find(|model| Some(&model.path) == planned.as_ref());
    let Some(other) = other else { return Ok(()) };
    let manifest = project.output_folder().join("manifest.json");
    let own = if project.model.path.is_dir() {
        format!("viewrank plan {}", command_path(&project.model.path))
    } else {
        "put the model into a folder of its own".into()
    };
    Err(Failure::new(
        Exit::Failed,
        format!(
            "{} is the plan of sub-model {}, which one of {} would replace",
            manifest.display(),
            other.name,
            project.model.name
        ),
        format!(
            "to have both: {own} (with a viewrank.toml of its own); to have the new one instead: remove {}",
            command_path(&manifest)
        ),
    ))
}

fn direction(text: &str) -> Result<[f64; 3], String> {
    let wrong = "three numbers with commas between, such as 0,0,1";
    let numbers: Vec<f64> = text
        .split(',')
        .map(|n| n.trim().parse().map_err(|_| wrong))
        .collect::<Result<_, _>>()?;
    Ok(numbers.try_into().map_err(|_| wrong)?)
}

fn write(
    arguments: &Arguments,
    project: &Project,
    plan: &Plan,
    files: &PlanFiles,
    progress: &ProgressDisplay,
) -> Result<(), Failure> {
    progress.progress(Stage::Write, 0, 1);
    // Of an earlier region.
    if project.home.join(MISSED).is_dir() {
        FileSet::new(&project.home, MISSED_SET).write(&project.disk())?;
    }
    // The plan is written last: if something else fails, it stays unchanged.
    if let Some(folder) = &arguments.dump_tables {
        let mut set = FileSet::new(folder, "tables");
        tables::add(plan, &mut set);
        // Not limited to the project: the user has named the folder.
        set.write(&Disk::REAL)?;
    }
    if let Some(path) = &arguments.dump_surface {
        output::replace(
            path,
            &ply::write(
                &plan.stages.surface.vertices,
                &plan.stages.surface.triangles,
                &[],
                &[],
            ),
            &Disk::REAL,
        )?;
    }
    let uncached = files.write(&project.disk())?;
    progress.progress(Stage::Write, 1, 1);
    uncached.iter().for_each(|warning| warn(warning));
    Ok(())
}

/// Reads the earlier plan: where this one is written or, if none is there yet, in the project.
fn earlier(project: &Project) -> Result<EarlierPlan, WrittenPlanError> {
    match EarlierPlan::read(project) {
        Err(WrittenPlanError::Io { source, .. })
            if source.kind() == ErrorKind::NotFound && project.is_elsewhere() =>
        {
            EarlierPlan::read(&Project {
                home: project.root.clone(),
                ..project.clone()
            })
        }
        read => read,
    }
}

/// Writes the report page, and returns its path.
fn page(
    project: &Project,
    plan: &mut Plan,
    files: &PlanFiles,
    progress: &ProgressDisplay,
) -> Result<PathBuf, Failure> {
    // What finished depth maps have measured is not on the page, whose surface is predicted
    // throughout.
    if plan.decision.finished > 0 {
        let page = super::report::write(&project.home, progress)?;
        return Ok(page.after_warning());
    }
    let exports = &files.manifest.exports;
    plan.warnings = warnings_with(&plan.warnings, exports, &[]);
    let folders = DepthMapFolders::default();
    let page = super::report::write_page(project, plan, exports, None, &folders, progress)?;
    Ok(page.after_warning())
}

fn report(
    arguments: &Arguments,
    project: &Project,
    plan: &Plan,
    files: &PlanFiles,
    asked: Asked,
) -> Result<(), Failure> {
    // What was asked for and cannot be written cannot without --dry-run either.
    let is_complete = arguments.backend.is_none() || files.not_exported.is_empty();
    let next = match (
        arguments.dry_run,
        arguments.quiet && arguments.format == Format::Text,
    ) {
        // Nobody would see it, and finding it may start programs.
        (_, true) => String::new(),
        (true, false) if is_complete => next::not_dry(),
        (_, false) => {
            let maps_of_run = project.home.join(plan.stages.backend);
            let again = |other: &str| {
                next::for_other_project(&arguments.project, other, plan.stages.backend)
            };
            let run = arguments.as_run(&maps_of_run);
            next::next(project, plan, files, run, &again)
        }
    };
    let summary = Summary::new(project, plan, files, arguments.dry_run, next, asked);
    let (said, look) = match arguments.format {
        Format::Json => return print_json(&summary),
        Format::Text if arguments.quiet => Default::default(),
        Format::Text => (summary.text(arguments.verbose), summary.where_to_look()),
    };
    // What the summary says, or the error will, is no warning as well.
    let is_said = |warning: &&String| {
        said.iter().any(|line| line.contains(*warning))
            || arguments.backend.is_some() && files.not_exported.contains(warning)
    };
    let warnings = summary.warnings.iter();
    let left: Vec<&String> = warnings.filter(|warning| !is_said(warning)).collect();
    print_sentences(said)?;
    print(look)?;
    left.into_iter().for_each(|warning| warn(warning));
    let backend = backends::by_name(plan.stages.backend).ok();
    if let Some(not_ready) = backend.and_then(backends::not_ready_here) {
        warn(&format!(
            "{}: run these files where a COLMAP with CUDA is, or plan with --backend openmvs or --backend sgm",
            not_ready.what
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::config::{Configuration, Files};

    #[derive(Parser)]
    struct Typed {
        #[command(flatten)]
        arguments: Arguments,
    }

    #[test]
    fn a_run_can_go_on_with_each_option_that_is_a_setting() {
        let words = "plan p -k 3 --budget 7 --target 80% --time 2h --points 5M --test-every 8 --region auto \
                     --gsd 0.1 --accuracy 0.1 --scales 1,0.5 --partners search --confidence none --surface 3d \
                     --up 0,0,1 --mesh m.ply --mesh-as-is --images i --pilot s --no-gps --seed 2 --max-memory 8G";
        let typed = Typed::parse_from(words.split_whitespace())
            .arguments
            .typed();
        let load = |typed| {
            let files = Files::default();
            let loaded = Configuration::load(&files, typed, backends::canonical_name);
            loaded.unwrap().settings
        };
        let planned = load(typed);
        let next = CommandLineSettings::default().following(planned.typed.clone());
        let next = load(next);
        let named = Vec::new();
        assert_eq!(
            next,
            Settings { named, ..planned },
            "all but who named files"
        );
    }
}
