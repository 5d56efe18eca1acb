//! `viewrank status`: the state of the projects under a root, from the daemon's status file.

use std::{
    collections::BTreeSet,
    io::ErrorKind,
    path::{Path, PathBuf},
    thread,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use crate::{
    apps::{
        dispatch::Dispatch,
        replan::{EarlierPlan, MapFolder},
    },
    backends::{self, known_maps},
    base::{
        error::{Advice, Hint, shortened},
        paths,
        printable::printable,
        shell::{command_path, shown_path},
    },
    daemon::{
        Line,
        follow::{self, Progress, modified, progress_file},
        phase::{Phase, ProjectStatus, STATUS_VERSION},
        read_status, status_file,
    },
    io::{
        depthmaps::{self, DepthMapError, DepthMapFile},
        project::{self, Project},
    },
    model::scene::Scene,
    show::{
        manifest::{self, PlannedMaps, WrittenPlan, planned_maps, planned_workspace},
        share::area_of_all,
    },
};
use clap::Args;
use serde_json::json;

use super::{
    Failure, Format, print, print_json, print_sentences, run::target_in_percent,
    terminal::print_json_line,
};

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
    // A folder or a file in a project means the project.
    let project = match project::containing(&project) {
        // Unless it has a plan of its own, as a folder of `--out` has.
        Some(above) if planned_maps(&project).is_none() => paths::from_here(&above),
        _ => project,
    };
    let Some(plan) = planned_maps(&project) else {
        return Err(NoStatus::NoPlan(project).into());
    };
    let opened = Project::open(&project, None).ok();
    let workspace = opened.and_then(|opened| planned_workspace(&opened));
    let home = workspace.unwrap_or_else(|| project.clone());
    // What was measured for an earlier plan is no progress of this one.
    let progress = Progress::read(&home).filter(|_| !follow::is_of_earlier_plan(&home));
    let there = MapsThere::look(&home, &plan.backend);
    let others = there.as_ref().and_then(|there| there.others.clone());
    let maps = there.map(|there| there.counted);
    let Some(progress) = progress else {
        let maps = maps.map_or(0, |maps| maps.len());
        let others = others.or_else(|| elsewhere(&plan, maps));
        return if is_json {
            print_json(&alone(&project, unmeasured(&plan, maps, others)))
        } else {
            print_sentences([planned_in_words(&plan, maps)].into_iter().chain(others))
        };
    };
    let gone = maps.as_ref().map_or(0, |maps| number_gone(maps, &progress));
    let later = number_later(&maps.unwrap_or_default(), &progress);
    let progress = with_note(without_gone(progress, gone), others);
    if is_json {
        let phase = progress.phase().of_plan_for(&plan.backend);
        print_json(&alone(&project, later_than(phase, later)))
    } else {
        print_sentences(unwatched(&progress, &plan, later))
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
        // A link counts: it is refused by name, and not passed over for a folder above.
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

/// The depth maps in a project with a plan.
struct MapsThere {
    /// Views of which the plan's program has made one for it.
    counted: Vec<String>,
    /// Says of the others that they do not count.
    others: Option<String>,
}

impl MapsThere {
    /// `None` where the folder of the program's maps cannot be listed.
    fn look(home: &Path, backend: &str) -> Option<Self> {
        let project = Project::open(home, None).ok()?;
        let folder = project.folder_of_maps(backend)?;
        let scene = project.read_scene().ok()?;
        let known = known_maps(backend, &folder);
        let found = in_folder(&folder, &scene, &known)?;
        let earlier = EarlierPlan::read(&project).ok();
        let maps = MapFolder {
            folder: &folder,
            ready: &|_| true,
            known: &known,
        };
        let by_run = maps_of_run(home, backend);
        let counts = |map: &&DepthMapFile| {
            let key = scene.name(map.view);
            match (&by_run, &earlier) {
                // The marks of tasks also tell size and options of a map.
                (Some(by_run), _) => by_run.contains(&paths::real(&map.path)),
                (None, Some(earlier)) => maps.counts(key, &map.path, earlier),
                (None, None) => false,
            }
        };
        let (counted, unknown): (Vec<_>, Vec<_>) = found.iter().partition(counts);
        let unknown = (
            unknown.len(),
            &folder,
            "nobody knows what they were made from (viewrank run makes anew what it needs)",
        );
        let folders = depthmaps::folders(home);
        let elsewhere = folders.iter().filter(|other| **other != folder);
        let elsewhere = elsewhere.map(|other| {
            let maps = in_folder(other, &scene, &|_| true).unwrap_or_default();
            let why = if other.ends_with(backend) {
                "they are not where its plan has its own"
            } else {
                "another program has made them"
            };
            (maps.len(), other, why)
        });
        let mut others = [unknown].into_iter().chain(elsewhere);
        let others = others.find(|(n, ..)| *n > 0).map(|(n, folder, why)| {
            let folder = shown_path(folder);
            let plural = if n == 1 { "" } else { "s" };
            format!("not counted for this plan for {backend}: {n} depth map{plural} in {folder}, since {why}.")
        });
        let name = |map: &DepthMapFile| scene.name(map.view).to_owned();
        Some(Self {
            counted: counted.into_iter().map(name).collect(),
            others,
        })
    }
}

/// The depth maps that `viewrank run` counts as finished; `None` for a program that it does not run
/// view by view, and where the plan cannot be exported again.
fn maps_of_run(home: &Path, backend: &str) -> Option<BTreeSet<PathBuf>> {
    let backend = backends::by_name(backend).ok()?;
    backend.tasks?;
    let plan = WrittenPlan::read(home).ok()?;
    let (dispatch, _) = Dispatch::of_plan(&plan, backend, plan.cut).ok()?;
    let maps = dispatch.finished_maps().map(paths::real);
    Some(maps.collect())
}

/// Says of finished depth maps that the plan was made around and that are not there that they do
/// not count.
fn elsewhere(plan: &PlannedMaps, there: usize) -> Option<String> {
    let (finished, _) = plan.finished?;
    let gone = finished.checked_sub(there).filter(|gone| *gone > 0)?;
    let (do_not, again) = match gone {
        1 => ("is not there and does not", "it"),
        _ => ("are not there and do not", "them"),
    };
    Some(format!(
        "of the finished depth maps that the plan was made around, {gone} {do_not} count: put {again} where {} writes its own, or viewrank run makes {again} again.",
        plan.backend
    ))
}

fn in_folder(
    folder: &Path,
    scene: &Scene,
    known: &dyn Fn(&Path) -> bool,
) -> Option<Vec<DepthMapFile>> {
    match depthmaps::list_preferring(folder, scene, known) {
        Ok(listed) => Some(listed.maps),
        Err(DepthMapError::Io { source, .. }) if source.kind() == ErrorKind::NotFound => {
            Some(Vec::new())
        }
        Err(_) => None,
    }
}

/// Number of depth maps that the last measurement did not see. Of those that it saw but could not
/// measure, its note speaks.
fn number_later(maps: &[String], progress: &Progress) -> usize {
    if progress.note.is_some() {
        return 0;
    }
    let outdated = progress.outdated.iter().map(|map| &map.key);
    let seen: BTreeSet<&String> = progress.finished.iter().chain(outdated).collect();
    maps.iter().filter(|view| !seen.contains(view)).count()
}

/// Number of depth maps that were measured and are no longer there.
fn number_gone(maps: &[String], progress: &Progress) -> usize {
    let there: BTreeSet<&String> = maps.iter().collect();
    let measured = progress.finished.iter();
    measured.filter(|view| !there.contains(view)).count()
}

fn with_note(mut progress: Progress, further: Option<String>) -> Progress {
    let notes: Vec<String> = progress.note.into_iter().chain(further).collect();
    progress.note = (!notes.is_empty()).then(|| notes.join("; "));
    progress
}

/// Returns the progress without the measured maps that are no longer there.
fn without_gone(mut progress: Progress, gone: usize) -> Progress {
    if gone > 0 {
        let said = match gone {
            1 => "1 measured depth map is gone: viewrank run makes it again.".into(),
            n => format!("{n} measured depth maps are gone: viewrank run makes them again."),
        };
        progress = with_note(progress, Some(said));
        progress.target_reached = false;
    }
    progress
}

fn later_than(mut phase: Phase, later: usize) -> Phase {
    if let Phase::Partial { unmeasured, .. } = &mut phase {
        *unmeasured = later;
    }
    phase
}

/// The phase of a project whose depth maps, if any, were not measured.
fn unmeasured(plan: &PlannedMaps, maps: usize, note: Option<String>) -> Phase {
    let (clusters, share, has_region) = (plan.clusters, plan.share, plan.has_region);
    if maps == 0 {
        return Phase::Planned {
            backend: plan.backend.clone(),
            clusters,
            share,
            has_region,
            lacks_export: false,
            note,
        };
    }
    let measured = plan.finished.filter(|(finished, _)| *finished <= maps);
    let (done, share) = measured.map_or((maps, None), |(done, share)| (done, Some(share)));
    Phase::Partial {
        backend: plan.backend.clone(),
        done,
        clusters,
        share,
        unmeasured: maps - measured.map_or(0, |_| done),
        has_region,
        note,
    }
}

/// Says what the plan chooses, before any depth map is measured.
fn planned_in_words(plan: &PlannedMaps, maps: usize) -> String {
    let PlannedMaps {
        clusters: planned,
        backend,
        finished,
        ..
    } = plan;
    match (
        backends::by_name(backend).map(|backend| backend.use_of_views),
        finished,
    ) {
        (Ok(Some(_)), _) => format!("{planned} images are planned; {backend} makes no depth maps."),
        (_, Some((done, share))) if *done <= maps => {
            let later = match maps - done {
                0 => String::new(),
                later => format!("; {later} more are there, not measured yet (viewrank evaluate)"),
            };
            format!(
                "{done} of {planned} planned depth maps finished: {}, as estimated from these maps{later}.",
                share_of_all(*share, plan)
            )
        }
        _ if maps > 0 => format!(
            "{planned} depth maps are planned, for {}; {maps} are there, not measured yet (viewrank evaluate).",
            share_of_all(plan.share, plan)
        ),
        _ => format!(
            "0 of {planned} planned depth maps finished; together they are to cover {}.",
            share_of_all(plan.share, plan)
        ),
    }
}

fn share_of_all(share: f64, plan: &PlannedMaps) -> String {
    let area = area_of_all(Some(plan.all), plan.has_region);
    format!("about {:.0} % of {area}", 100.0 * share.clamp(0.0, 1.0))
}

/// What is finished of a project that no daemon watches.
fn unwatched(progress: &Progress, plan: &PlannedMaps, later: usize) -> Vec<String> {
    let Progress { done, clusters, .. } = progress;
    let wanted = match plan.target {
        Some(target) => format!("target: {}", target_in_percent(target)),
        None => format!(
            "the plan said {:.0} % for its {}",
            100.0 * plan.share,
            plan.clusters
        ),
    };
    let share = progress.share.map_or_else(String::new, |share| {
        format!(": {} ({wanted})", share_of_all(share, plan))
    });
    let mut lines = vec![format!(
        "{done} of {clusters} planned depth maps finished{share}."
    )];
    lines.extend(progress.note.clone());
    // Without a target of the user's the list ends the work, whatever it reached.
    lines.extend(match plan.target {
        _ if !progress.target_reached => None,
        Some(target) => Some(format!(
            "The target of {} is reached.",
            target_in_percent(target)
        )),
        None => Some("The plan is done.".into()),
    });
    lines.push("As last estimated by `viewrank run`, `watch` or `evaluate`.".into());
    lines.extend(backends::caution(&plan.backend).map(String::from));
    lines.extend(match later {
        0 => None,
        1 => Some("1 depth map was finished after that (viewrank evaluate).".into()),
        n => Some(format!(
            "{n} depth maps were finished after that (viewrank evaluate)."
        )),
    });
    lines
}

/// The status of a project that no daemon watches, as [`as_json`] gives that of a watched folder.
fn alone(project: &Path, phase: Phase) -> serde_json::Value {
    let written = [progress_file(project), project.join(manifest::FILE)];
    let since = written.iter().find_map(|file| modified(file));
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
            "  {name:width$}  {}{measuring} ({} ago)",
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
