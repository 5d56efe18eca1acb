//! `viewrank status`: the state of the projects under a root, from the daemon's status file.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    thread,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use crate::{
    apps::evaluate::{EVALUATION_FILE, WrittenEvaluation},
    backends,
    base::{
        error::{Advice, Hint, shortened},
        printable::printable,
        shell::{command_path, shown_path},
    },
    daemon::{
        Line,
        follow::{Progress, progress_file},
        phase::{Phase, ProjectStatus, STATUS_VERSION},
        read_status, status_file,
    },
    io::{
        depthmaps::{self, DepthMapFile},
        paths::from_here,
        project::Project,
    },
    show::manifest::{self, PlannedMaps, planned_maps, planned_workspace},
};
use clap::Args;
use serde_json::json;

use super::{Failure, Format, print, print_json, terminal::print_json_line};

/// Show what is planned and finished of a project, or of all under a watched folder.
#[derive(Args)]
pub struct Arguments {
    /// The project, the watched folder, or any folder below that.
    #[arg(default_value = ".")]
    root: PathBuf,
    /// Print the status as JSON, as --format json.
    #[arg(long)]
    json: bool,
    /// Format of the results on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    /// Keep printing changes (as JSON, one line each).
    #[arg(long)]
    follow: bool,
}

/// Polling interval of `--follow`.
const FOLLOW: Duration = Duration::from_millis(500);

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let is_json = arguments.json || arguments.format == Format::Json;
    let root = match watched_root(&arguments.root) {
        // A project that `viewrank run` or a queue works on needs no daemon.
        Err(NoStatus::NotWatched(project)) if !arguments.follow => {
            return print_unwatched(project, is_json);
        }
        root => root?,
    };
    let mut last = None;
    loop {
        let line = read_status(&root).filter(|line| last.as_ref() != Some(line));
        if let Some(line) = line {
            match (is_json, arguments.follow) {
                (false, _) => print(as_text(&root, &line))?,
                (true, false) => print_json(&as_json(&root, &line))?,
                (true, true) => print_json_line(&as_json(&root, &line))?,
            }
            last = Some(line);
        }
        if !arguments.follow {
            return Ok(());
        }
        thread::sleep(FOLLOW);
    }
}

/// Prints the state of a project by its own files.
fn print_unwatched(project: PathBuf, is_json: bool) -> Result<(), Failure> {
    let Some(plan) = planned_maps(&project) else {
        return match Progress::read(&project) {
            Some(progress) if is_json => print_json(&alone(&project, progress.phase(), None)),
            Some(progress) => print(in_words(&progress)),
            None => Err(NoStatus::NoPlan(project).into()),
        };
    };
    let Some(last) = LastMeasurement::of(&project, &plan) else {
        let maps = MapsThere::of_plan(&project, &plan.backend).number();
        return if is_json {
            print_json(&alone(&project, unmeasured(&plan, maps), None))
        } else {
            print([planned_in_words(&plan, maps)])
        };
    };
    if is_json {
        let at = last.at;
        print_json(&alone(&project, last.phase(), Some(at)))
    } else {
        print(last.in_words())
    }
}

/// Finds the nearest folder, from here upwards, that a daemon watched.
fn watched_root(from: &Path) -> Result<PathBuf, NoStatus> {
    let absolute = dunce::canonicalize(from).unwrap_or_else(|_| from.into());
    if !absolute.exists() {
        return Err(NoStatus::NotFound(from.into()));
    }
    let found = absolute
        .ancestors()
        .find(|folder| status_file(folder).symlink_metadata().is_ok());
    let root = found.ok_or_else(|| NoStatus::NotWatched(from.into()))?;
    read_status(root)
        .map(|_| root.into())
        .ok_or_else(|| NoStatus::Unreadable(status_file(root)))
}

#[derive(Debug, thiserror::Error)]
enum NoStatus {
    #[error("{}: no such folder", .0.display())]
    NotFound(PathBuf),
    #[error("no daemon has watched {} or a folder above it", .0.display())]
    NotWatched(PathBuf),
    #[error("{} has no plan, and no daemon has watched it", shown_path(.0))]
    NoPlan(PathBuf),
    #[error("{} cannot be read, or is no status of this version", .0.display())]
    Unreadable(PathBuf),
}

impl Hint for NoStatus {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::NotFound(_) => {
                "name the folder that was given to viewrank watch, or a project below it".into()
            }
            Self::NotWatched(folder) => {
                format!("start one: viewrank watch {}", command_path(folder)).into()
            }
            Self::NoPlan(folder) => {
                format!("plan it: viewrank plan {}", command_path(folder)).into()
            }
            Self::Unreadable(_) => {
                "make it readable, or start a daemon of this version, which rewrites it".into()
            }
        })
    }
}

fn modified(file: &Path) -> Option<SystemTime> {
    file.metadata().ok()?.modified().ok()
}

/// The last measurement of the depth maps of a plan, and what was finished after it.
struct LastMeasurement {
    progress: Progress,
    at: SystemTime,
    /// The command that measured, in words.
    by: String,
    /// Depth maps that are new or changed since.
    unmeasured: usize,
}

impl LastMeasurement {
    /// Returns the newer of what `run` or `watch` and `evaluate` measured; `None` if neither did
    /// since the project was planned.
    fn of(project: &Path, plan: &PlannedMaps) -> Option<Self> {
        let opened = Project::open(project, None).ok();
        let home = opened.as_ref().and_then(planned_workspace);
        let home = home.unwrap_or(project);
        let planned = modified(&home.join(manifest::FILE));
        let time = |file: PathBuf| modified(&file).filter(|&at| Some(at) >= planned);
        // The progress of a project that is matched in a workspace may be beside either.
        let followed = [project, home].into_iter().find_map(|root| {
            let at = time(progress_file(root))?;
            Some((at, Progress::read(root)?))
        });
        let evaluated = time(home.join(EVALUATION_FILE))
            .and_then(|at| Some((at, WrittenEvaluation::read(home)?)));
        let (at, progress, folder, by) = match (followed, evaluated) {
            (Some((at, progress)), evaluated) if evaluated.as_ref().is_none_or(|of| of.0 < at) => {
                let by = "As measured at the last depth map that `viewrank run` or `watch` saw.";
                (at, progress, None, by.into())
            }
            (_, Some((at, evaluation))) => {
                let folder = shown_path(&from_here(&evaluation.depth_maps));
                let by = format!("As `viewrank evaluate` measured those in {folder}.");
                let progress = evaluated_progress(&evaluation, plan);
                (at, progress, Some(evaluation.depth_maps), by)
            }
            _ => return None,
        };
        let there = match folder {
            Some(folder) => MapsThere::read(project, |_| folder),
            None => MapsThere::of_plan(project, &plan.backend),
        };
        Some(Self {
            unmeasured: there.unmeasured(&progress, at),
            at,
            progress,
            by,
        })
    }

    fn phase(self) -> Phase {
        let mut phase = self.progress.phase();
        if let Phase::Partial { unmeasured, .. } = &mut phase {
            *unmeasured = self.unmeasured;
        }
        phase
    }

    fn in_words(&self) -> Vec<String> {
        let mut lines = in_words(&self.progress);
        lines.push(self.by.clone());
        lines.extend(match self.unmeasured {
            0 => None,
            1 => Some("1 depth map is new or changed since (viewrank evaluate).".into()),
            n => Some(format!(
                "{n} depth maps are new or changed since (viewrank evaluate)."
            )),
        });
        lines
    }
}

/// Converts what `viewrank evaluate` measured to the progress of the plan, as a daemon would see it.
fn evaluated_progress(evaluation: &WrittenEvaluation, plan: &PlannedMaps) -> Progress {
    let finished: Vec<String> = evaluation.key_views().map(String::from).collect();
    let listed: BTreeSet<&String> = plan.keys.iter().collect();
    let beyond = finished.iter().filter(|key| !listed.contains(key)).count();
    let (done, clusters) = (finished.len(), plan.clusters + beyond);
    let share = evaluation.share().unwrap_or_default();
    Progress {
        target_reached: match plan.target {
            Some(target) => share >= target,
            None => done >= clusters,
        },
        done,
        clusters,
        share: Some(share),
        target: plan.target.unwrap_or(plan.share),
        finished,
        ..Progress::default()
    }
}

/// The depth maps in a folder: names of their views, and when they were made.
#[derive(Default)]
struct MapsThere(Vec<(String, Option<SystemTime>)>);

impl MapsThere {
    /// Those that the plan's program has made of the project's views.
    fn of_plan(project: &Path, backend: &str) -> Self {
        Self::read(project, |project| {
            depthmaps::folder_of(&project.home, project.dense_workspace.as_deref(), backend)
        })
    }

    fn read(project: &Path, folder: impl FnOnce(&Project) -> PathBuf) -> Self {
        let read = || {
            let project = Project::open(project, None).ok()?;
            let scene = project.read_scene().ok()?;
            let found = depthmaps::list(&folder(&project), &scene).ok()?.maps;
            let map = |map: &DepthMapFile| (scene.name(map.view).to_owned(), modified(&map.path));
            Some(Self(found.iter().map(map).collect()))
        };
        read().unwrap_or_default()
    }

    fn number(&self) -> usize {
        self.0.len()
    }

    /// Number of maps that the measurement did not see, or saw before they changed.
    fn unmeasured(&self, measured: &Progress, at: SystemTime) -> usize {
        let finished: BTreeSet<&String> = measured.finished.iter().collect();
        let outdated: BTreeSet<&String> = measured.outdated.iter().map(|map| &map.key).collect();
        let is_new = |(view, made): &&(String, Option<SystemTime>)| {
            let is_known = finished.contains(view) || outdated.contains(view);
            !is_known || made.is_some_and(|made| made > at)
        };
        self.0.iter().filter(is_new).count()
    }
}

/// The phase of a project whose depth maps, if any, were not measured.
fn unmeasured(plan: &PlannedMaps, maps: usize) -> Phase {
    let (clusters, share, note) = (plan.clusters, plan.share, None);
    if maps == 0 {
        return Phase::Planned {
            clusters,
            share,
            note,
        };
    }
    Phase::Partial {
        done: maps,
        clusters,
        share: None,
        unmeasured: maps,
        note,
    }
}

/// Says what the plan chooses, before any depth map is measured.
fn planned_in_words(plan: &PlannedMaps, maps: usize) -> String {
    let PlannedMaps {
        clusters: planned,
        backend,
        ..
    } = plan;
    match backends::by_name(backend).map(|backend| backend.use_of_views) {
        Ok(Some(_)) => format!("{planned} images are planned; {backend} makes no depth maps."),
        _ if maps > 0 => format!(
            "{planned} depth maps are planned; {maps} are there, not measured yet (viewrank evaluate)."
        ),
        _ => format!("0 of {planned} planned depth maps are finished."),
    }
}

/// What is finished of a project that no daemon watches.
fn in_words(progress: &Progress) -> Vec<String> {
    let Progress { done, clusters, .. } = progress;
    let share = match progress.share {
        Some(share) => format!(
            ": about {:.0} % of the area that all maps would cover (planned: {:.0} %)",
            100.0 * share,
            100.0 * progress.target
        ),
        None => String::new(),
    };
    let mut lines = vec![format!(
        "{done} of {clusters} planned depth maps are finished{share}."
    )];
    lines.extend(progress.note.clone());
    // Without a target of the user's the list ends the work, whatever it reached.
    let is_reached = progress.share.is_some_and(|share| share >= progress.target);
    match (progress.target_reached, is_reached) {
        (true, true) => lines.push("The planned share is reached.".into()),
        (true, false) => lines.push("The list is done.".into()),
        (false, _) => {}
    }
    lines
}

/// The status of a project that no daemon watches, as [`as_json`] gives that of a watched folder.
/// `measured`: when its depth maps were.
fn alone(project: &Path, phase: Phase, measured: Option<SystemTime>) -> serde_json::Value {
    let since = measured.or_else(|| modified(&project.join(manifest::FILE)));
    let since = since.and_then(|time| Some(time.duration_since(UNIX_EPOCH).ok()?.as_secs()));
    let mut own = serde_json::to_value(phase).expect("a phase is JSON");
    own["project"] = ".".into();
    own["since"] = since.unwrap_or_default().into();
    let root = dunce::canonicalize(project).unwrap_or_else(|_| project.into());
    json!({
        "version": STATUS_VERSION,
        "root": root.to_string_lossy(),
        "running": false,
        "notices": [],
        "projects": [own],
    })
}

fn as_json(root: &Path, line: &Line) -> serde_json::Value {
    let mut value = serde_json::to_value(&line.status).expect("a status is JSON");
    value["root"] = root.to_string_lossy().into();
    value["running"] = line.running.into();
    value
}

fn as_text(root: &Path, line: &Line) -> Vec<String> {
    let status = &line.status;
    let daemon = if line.running {
        format!("watched by process {} on {}", status.pid, status.host)
    } else {
        "no daemon is running; this is how things stood when it ended".into()
    };
    let mut lines = vec![format!("{}: {daemon}", root.display())];
    lines.extend(
        status
            .notices
            .iter()
            .map(|notice| format!("note: {notice}")),
    );
    let width = status
        .projects
        .iter()
        .map(|p| p.project.chars().count())
        .max()
        .unwrap_or(0)
        .min(32);
    for project in &status.projects {
        let name = printable(&shortened(&project.project));
        let measuring = if project.measuring {
            ", being measured"
        } else {
            ""
        };
        lines.push(format!(
            "  {name:width$}  {}{measuring} ({})",
            project.phase,
            age(project)
        ));
        if let Phase::Failed {
            hint: Some(hint), ..
        } = &project.phase
        {
            lines.push(format!("  {:width$}  hint: {hint}", ""));
        }
    }
    if status.projects.is_empty() {
        lines.push("  no projects yet".into());
    }
    lines
}

/// Formats the time since the project entered its state.
fn age(project: &ProjectStatus) -> String {
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |d| d.as_secs());
    match now.saturating_sub(project.since) {
        s @ 0..=119 => format!("{s} s"),
        s @ 120..=7199 => format!("{} min", s / 60),
        s @ 7200..=172_799 => format!("{} h", s / 3600),
        s => format!("{} days", s / 86_400),
    }
}
