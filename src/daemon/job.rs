//! Jobs: plan a project with the same functions as `viewrank plan`, or measure its depth maps.

use std::{
    collections::BTreeMap,
    io,
    path::{Path, PathBuf},
    process::{Child, Stdio},
    sync::{
        Mutex,
        atomic::{AtomicU8, Ordering},
    },
    thread,
};

use tracing::{info, warn};

use super::{
    Job, Planner,
    discover::may_enter,
    follow::{FollowJob, Progress, failed, outdated_note, own_folder, progress_file},
    kept::PlanCache,
    maps::{map_files, map_files_inside},
    phase::chosen_for,
    planned_from::{PlannedFrom, RECORD},
    platform, queue,
    settle::{Fingerprint, HashCache, lock},
    state::Outcome,
};
use crate::base::advice::on_command_line;
use crate::{
    apps::{
        dispatch::Dispatch,
        planning,
        replan::{self, EarlierPlan, MapFolder, RepeatError, ReplanError, replan},
    },
    backends::{self, known_maps},
    base::{
        error::Hint,
        progress::{Stage, Watcher},
    },
    config::{CommandLineSettings, Configuration, Files, Settings, user_file},
    io::{
        output::{self, Disk},
        project::{Project, ProjectError},
    },
    plan::{EmptyPlan, Plan, PlanError, metres_per_unit},
    show::{
        files,
        manifest::{RecordedPlan, WrittenPlanError, planned_backend, warnings_with},
    },
};

/// Options of the planner of `viewrank watch`.
#[derive(Clone, Debug)]
pub struct PlanOptions {
    /// Shell command to run when a project's target is reached, with the project's folder in
    /// VIEWRANK_PROJECT. It comes from the user who started the daemon, never from a project;
    /// `None`: taken from the user's own `viewrank.toml`.
    pub on_target: Option<String>,
    /// Rank the remaining clusters again after each measurement (method 5.4).
    pub replan: bool,
    /// Bytes of the plans that are kept in memory while their depth maps come.
    pub cache: u64,
    pub follow_links: bool,
    /// Watched folders, whose `viewrank.toml` counts for all projects in them.
    pub roots: Vec<PathBuf>,
    /// Settings of the command line.
    pub typed: CommandLineSettings,
    /// True in `viewrank run`, false in the daemon, which makes no plan under a run.
    pub is_run: bool,
}

/// When a project is planned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlanWhen {
    /// Where its last plan was made of something else.
    Outdated,
    /// Anyhow, around the depth maps that are finished by now.
    AroundMaps,
}

/// The planner of `viewrank watch`: [`plan::plan`], [`replan()`] and [`plan::files`].
pub struct PlanJob {
    options: PlanOptions,
    /// The watched folders as they were resolved at the start.
    roots: Vec<PathBuf>,
    plans: Mutex<PlanCache>,
    hashes: Mutex<HashCache>,
    /// The last settings of each project that could be read.
    valid_settings: Mutex<BTreeMap<PathBuf, Settings>>,
}

/// Result of a step of a job, or the outcome that ends the job early.
type StepResult<T> = Result<T, Outcome>;

/// Returns the outcome of a job whose step ended early: abandoned if the job was cancelled.
fn of_ended(ended: Outcome, job: &Job) -> Outcome {
    if job.is_cancelled() {
        Outcome::Abandoned
    } else {
        ended
    }
}

impl Planner for PlanJob {
    fn named_files(&self, project: &Path) -> Vec<PathBuf> {
        // In the daemon's own process, which reads no model: no file depends on its unit.
        let settings = match self.settings_of_files(project, &|_| Some(1.0)) {
            Ok(settings) => settings,
            // While the settings are invalid, the files that they named still count.
            Err(_) => self.last_settings(project).unwrap_or_default(),
        };
        let files = [user_file(), self.root_file(project)];
        files
            .into_iter()
            .flatten()
            .chain(settings.files_of_plan())
            .collect()
    }

    fn has_plan(&self, project: &Path) -> bool {
        PlannedFrom::read(project).is_some()
    }

    fn plan(&self, job: &Job) -> Outcome {
        self.plan_if(PlanWhen::Outdated, job)
    }

    fn follow(&self, job: &Job) -> Outcome {
        self.try_follow(job)
            .unwrap_or_else(|ended| of_ended(ended, job))
    }

    fn forget(&self, project: &Path) {
        lock(&self.hashes).forget(project);
        lock(&self.valid_settings).remove(project);
        lock(&self.plans).forget(project);
    }
}

impl PlanJob {
    pub fn new(options: PlanOptions) -> Self {
        let plans = Mutex::new(PlanCache::new(options.cache));
        let roots = options.roots.iter();
        let roots = roots.filter_map(|root| dunce::canonicalize(root).ok());
        Self {
            roots: roots.collect(),
            options,
            plans,
            hashes: Mutex::default(),
            valid_settings: Mutex::default(),
        }
    }

    /// Plans the project at this time ([`Planner::plan`]: where the plan is outdated).
    pub(super) fn plan_if(&self, when: PlanWhen, job: &Job) -> Outcome {
        self.try_plan(when, job)
            .unwrap_or_else(|ended| of_ended(ended, job))
    }

    fn try_plan(&self, when: PlanWhen, job: &Job) -> StepResult<Outcome> {
        let within = self.within(job.project)?;
        let disk = Disk::REAL.within(&within);
        output::recover(job.project, &disk).map_err(failed)?;
        let is_by_hand = !job.project.join(RECORD).exists();
        let progress = progress_file(job.project);
        let had_maps = progress.is_file()
            || PlannedFrom::read(job.project).is_some_and(|record| record.finished);
        if !had_maps || self.has_maps(job)? {
            return self.plan_input(when, job, is_by_hand, &disk);
        }
        // The depth maps are gone: nothing is finished or reached any more. The progress is removed
        // last, so that the next run completes an interrupted one.
        output::remove(&job.project.join(RECORD), &disk).map_err(failed)?;
        let outcome = self.plan_input(when, job, is_by_hand, &disk)?;
        Progress::remove(job.project, &disk).map_err(failed)?;
        Ok(outcome)
    }

    /// `is_by_hand`: a plan that is there is not the daemon's.
    fn plan_input(
        &self,
        when: PlanWhen,
        job: &Job,
        is_by_hand: bool,
        disk: &Disk,
    ) -> StepResult<Outcome> {
        refuse_unreadable(job)?;
        let (settings, note) = self.settings(job.project)?;
        let project = Project::open(job.project, None)
            .map_err(incomplete)?
            .with_images(settings.images.as_deref());
        let model = project.model_files();
        refuse_links(job, &model)?;
        let fingerprint = self.fingerprint(job, &project, &settings, &model)?;
        if let (PlanWhen::Outdated, Some(planned)) =
            (when, planned_before(job, &fingerprint, &note))
        {
            return Ok(planned);
        }
        // Not earlier: a plan that is current needs no memory.
        refuse_large(job, &model)?;
        if !self.options.is_run {
            Dispatch::refuse_if_at_work(&project).map_err(failed)?;
        }
        info!(project = %job.project.display(), "planning");
        let plan = planned(&project, &settings, job)?;
        // Compared before the new plan takes its place.
        let replaced = (is_by_hand && !self.options.is_run)
            .then(|| another_than(&plan, &project))
            .flatten();
        let record = PlannedFrom::new(&plan, fingerprint.clone(), settings.for_plan());
        if job.is_wanted() {
            Progress::clear_target_reached(job.project, disk).map_err(failed)?;
        }
        let written = write(&plan, &project, record, job, disk)?;
        for warning in written.warnings {
            warn!(project = %job.project.display(), "{warning}");
        }
        let lacks_export = !written.missing.is_empty();
        Ok(Outcome::Planned {
            fingerprint,
            backend: plan.stages.backend.into(),
            clusters: plan.decision.cut.clusters,
            share: plan.decision.cut.share,
            has_region: settings.region.is_some(),
            lacks_export,
            note: lacks_export
                .then(|| written.missing.join("; "))
                .or(note)
                .or_else(|| outdated_note(&plan.finished.outdated, "manifest.json"))
                .or(replaced),
            anew: true,
            known: None,
        })
    }

    /// The fingerprint of all that a plan is made of.
    fn fingerprint(
        &self,
        job: &Job,
        project: &Project,
        settings: &Settings,
        model: &[PathBuf],
    ) -> StepResult<Fingerprint> {
        // A dense workspace that appears later gets its files, too.
        let decided_by = (settings.for_plan(), &project.dense_workspace);
        let as_text = serde_json::to_vec(&decided_by).map_err(|_| Outcome::Abandoned)?;
        HashCache::fingerprint(&self.hashes, job.project, model, job.stamp, &as_text)
            .map_err(unreadable)
    }

    /// Returns whether there are depth maps of the plan's program, also such as have not settled
    /// yet.
    fn has_maps(&self, job: &Job) -> StepResult<bool> {
        let found = if self.options.is_run {
            map_files_inside(job.project)
        } else {
            map_files(job.project, job.follow_links)
        };
        let files = found.map_err(failed)?;
        let project = Project::open(job.project, None).map_err(incomplete)?;
        let planned = planned_backend(&project);
        Ok(planned.map_or(!files.is_empty(), |backend| {
            own_folder(&project, &backend, &files).is_some()
        }))
    }

    fn try_follow(&self, job: &Job) -> StepResult<Outcome> {
        let within = self.within(job.project)?;
        let disk = Disk::REAL.within(&within);
        output::recover(job.project, &disk).map_err(failed)?;
        if job.maps.is_empty() {
            return self.without_maps(job);
        }
        let record = self.record_or_plan(job)?;
        let opened = Project::open(job.project, None).map_err(incomplete)?;
        let Some(folder) = own_folder(&opened, &record.backend, job.maps) else {
            return self.without_maps(job);
        };
        let watcher = JobWatcher::new(job);
        let (project, plan) = self.plan_again(job.project, &record.fingerprint, &watcher)?;
        let earlier = EarlierPlan::read(&project).map_err(failed)?;
        // A run has chosen those of its own tasks.
        let known = (!self.options.is_run).then(|| known_maps(&record.backend, &folder));
        let following = FollowJob {
            plan,
            earlier: &earlier,
            maps: MapFolder {
                folder: &folder,
                ready: &|map| job.maps.contains_key(map),
                known: &|map| known.as_ref().is_none_or(|known| known(map)),
            },
            replan: self.options.replan,
        };
        let (plan, mut progress) = following.measure(&watcher).map_err(failed)?;
        // A first `progress.json` would say that the backend is at work.
        if progress.is_of_no_maps() && !progress_file(job.project).is_file() {
            return Err(Outcome::Abandoned);
        }
        // The plan before the progress, which counts along the list that is written.
        if self.options.replan {
            write(
                &plan,
                &project,
                PlannedFrom::new(&plan, record.fingerprint, record.settings),
                job,
                &disk,
            )?;
        }
        self.write_progress(&mut progress, job.project, &disk)?;
        let note = self.settings(job.project).ok().and_then(|(_, note)| note);
        Ok(progress.outcome(note))
    }

    /// Follows a project without depth maps: where they are gone, it is planned anew.
    fn without_maps(&self, job: &Job) -> StepResult<Outcome> {
        if !self.has_maps(job)? && progress_file(job.project).is_file() {
            self.try_plan(PlanWhen::Outdated, job)
        } else {
            Err(Outcome::Abandoned)
        }
    }

    /// Writes the progress, and announces a target that is reached now.
    fn write_progress(&self, progress: &mut Progress, root: &Path, disk: &Disk) -> StepResult<()> {
        progress.keep_announced(root);
        progress.write(root, disk).map_err(failed)?;
        if progress.target_reached && !progress.announced {
            // The command may read the progress, so that is written first; and once more after it,
            // or a restart would run the command again.
            progress.announced = self.announce(root);
            progress.write(root, disk).map_err(failed)?;
        }
        Ok(())
    }

    /// Returns the record of the plan, which is made anew if it is gone, or was replaced by hand.
    fn record_or_plan(&self, job: &Job) -> StepResult<PlannedFrom> {
        if let Some(record) = PlannedFrom::read(job.project) {
            return Ok(record);
        }
        let planned = self.try_plan(PlanWhen::Outdated, job)?;
        PlannedFrom::read(job.project).ok_or(planned)
    }

    /// Returns the plan by prediction alone, from the cache if possible.
    fn plan_again(
        &self,
        root: &Path,
        fingerprint: &Fingerprint,
        watcher: &JobWatcher,
    ) -> StepResult<(Project, Plan)> {
        if let Some(plan) = lock(&self.plans).get(root, fingerprint) {
            let images = plan.stages.settings.images.clone();
            return Ok((
                Project::open(root, None)
                    .map_err(failed)?
                    .with_images(images.as_deref()),
                plan,
            ));
        }
        let (project, plan) = replan::repeat(root, watcher).map_err(|error| match error {
            // The change of the input starts a job of its own.
            RepeatError::Written(WrittenPlanError::OtherInput(_)) => Outcome::Abandoned,
            error => failed(error),
        })?;
        lock(&self.plans).put(root, fingerprint.clone(), &plan);
        Ok((project, plan))
    }

    /// Starts the user's command for a reached target without waiting for it; false if there is
    /// none or it can't be started.
    fn announce(&self, project: &Path) -> bool {
        let command = match &self.options.on_target {
            Some(command) => Some(command.clone()),
            None => match Configuration::load(
                // The user's own file alone: a command in a project would be a stranger's.
                &Files {
                    user: user_file(),
                    ..Files::default()
                },
                CommandLineSettings::default(),
                backends::canonical_name,
            ) {
                Ok(configuration) => configuration.settings.on_target,
                Err(error) => {
                    warn!(%error, "cannot read the on_target command");
                    // Not announced, so that the next measurement tries again.
                    return false;
                }
            },
        };
        let Some(command) = command else { return false };
        // Standard output may be a worker's answers.
        #[expect(
            clippy::disallowed_methods,
            reason = "the command's own words, not viewrank's"
        )]
        let output = io::stderr();
        let started = platform::shell(&command).and_then(|mut command| {
            command
                .env("VIEWRANK_PROJECT", project)
                .stdin(Stdio::null())
                .stdout(output)
                .spawn()
        });
        match started {
            Ok(child) => {
                let project = project.to_path_buf();
                // Unless it is waited for, it stays a zombie as long as the daemon runs.
                thread::spawn(move || wait_for(child, &project));
                true
            }
            Err(error) => {
                warn!(project = %project.display(), %error, "cannot run the on_target command");
                false
            }
        }
    }

    /// `viewrank.toml` of the watched folder that a project is in, whether it exists or not; `None`
    /// if the project is the folder itself.
    fn root_file(&self, project: &Path) -> Option<PathBuf> {
        let above = self.watched(project).filter(|root| *root != project);
        above
            .max_by_key(|root| root.components().count())
            .map(|root| root.join("viewrank.toml"))
    }

    /// The watched folders that a project is in, or is.
    fn watched(&self, project: &Path) -> impl Iterator<Item = &Path> {
        let roots = self.roots.iter().map(PathBuf::as_path);
        roots.filter(move |root| project.starts_with(root))
    }

    /// The watched folder and the project, for [`Disk::within`].
    ///
    /// # Errors
    /// Where the project is in none: a folder was exchanged for a link before it was resolved.
    fn within(&self, project: &Path) -> StepResult<Vec<PathBuf>> {
        let outermost = self
            .watched(project)
            .min_by_key(|root| root.components().count());
        let root = match outermost {
            _ if self.options.follow_links => None,
            None if !self.options.roots.is_empty() => {
                return Err(Outcome::Failed {
                    reason: "not in a watched folder any more".into(),
                    hint: Some("start viewrank watch again".into()),
                });
            }
            root => root,
        };
        Ok(root
            .into_iter()
            .chain([project])
            .map(Path::to_path_buf)
            .collect())
    }

    /// Returns the project's settings. Where they are invalid now, returns the last valid ones, at
    /// least those of its plan, with a note.
    fn settings(&self, project: &Path) -> StepResult<(Settings, Option<String>)> {
        let metres = |settings: &Settings| {
            metres_per_unit(&Project::open(project, None).ok()?, settings).ok()?
        };
        match self.settings_of_files(project, &metres) {
            Ok(settings) => {
                lock(&self.valid_settings).insert(project.into(), settings.clone());
                Ok((settings, None))
            }
            Err((error, failure)) => match self.last_settings(project) {
                Some(valid) => Ok((
                    valid,
                    Some(format!("{error}; using the last valid settings")),
                )),
                None => Err(failure),
            },
        }
    }

    fn settings_of_files(
        &self,
        project: &Path,
        metres: &dyn Fn(&Settings) -> Option<f64>,
    ) -> Result<Settings, (String, Outcome)> {
        let own = project.join("viewrank.toml");
        if !may_enter(project, &own, self.options.follow_links) {
            let reason = format!("{} is a symbolic link (--follow-links)", own.display());
            return Err((reason.clone(), Outcome::Failed { reason, hint: None }));
        }
        let files = Files {
            user: user_file(),
            root: self.root_file(project),
            project: Some(own),
        };
        let typed = self.options.typed.clone();
        Configuration::load_for(&files, typed, backends::canonical_name, metres)
            .map(|configuration| configuration.settings)
            .map_err(|error| (error.to_string(), failed(error)))
    }

    fn last_settings(&self, project: &Path) -> Option<Settings> {
        let known = lock(&self.valid_settings).get(project).cloned();
        let of_plan = || {
            let settings = PlannedFrom::read(project)?.settings;
            // The record may have come with a stranger's project, and must name no file of the
            // user's.
            (!settings.leads_out(project)).then_some(settings)
        };
        known.or_else(of_plan)
    }
}

fn refuse_links(job: &Job, model: &[PathBuf]) -> StepResult<()> {
    let is_behind_link = |file: &&PathBuf| !may_enter(job.project, file, job.follow_links);
    match model.iter().find(is_behind_link) {
        Some(file) => Err(Outcome::Incomplete {
            reason: format!(
                "{} is behind a symbolic link (--follow-links)",
                file.display()
            ),
        }),
        None => Ok(()),
    }
}

/// Refuses a project whose files cannot be looked at.
fn refuse_unreadable(job: &Job) -> StepResult<()> {
    let Some(reason) = job.stamp.read_error() else {
        return Ok(());
    };
    let hint = Some("make it readable for the user who runs viewrank".into());
    Err(Outcome::Failed { reason, hint })
}

/// Refuses a model that is larger than the memory for its plan: the forecast comes after the model
/// is read, which takes about as much memory as its files have bytes.
fn refuse_large(job: &Job, model: &[PathBuf]) -> StepResult<()> {
    let files = model.iter().filter_map(|file| file.metadata().ok());
    let bytes = files.map(|file| file.len()).sum();
    let Some(most) = job.most_memory.filter(|most| bytes > *most) else {
        return Ok(());
    };
    let mib = |bytes: u64| bytes.div_ceil(1 << 20);
    let reason = format!(
        "the model alone has {} MiB, --max-memory allows {} MiB",
        mib(bytes),
        mib(most)
    );
    let hint = Some(format!(
        "give viewrank watch --max-memory {}M or more",
        mib(queue::need(bytes))
    ));
    Err(Outcome::Aside { reason, hint })
}

/// Returns the outcome of the last plan, if it was made of the same.
fn planned_before(job: &Job, fingerprint: &Fingerprint, note: &Option<String>) -> Option<Outcome> {
    let record = PlannedFrom::read(job.project)?;
    if record.fingerprint != *fingerprint {
        return None;
    }
    // The last measurement holds until the next one.
    let known = Progress::read(job.project).filter(|progress| progress.done > 0);
    let known = known.map(|progress| Box::new(progress.outcome(note.clone())));
    // What was missing may be there now. Where there are depth maps, nobody waits for the export.
    if record.lacks_export && known.is_none() {
        return None;
    }
    Some(Outcome::Planned {
        fingerprint: record.fingerprint,
        backend: record.backend,
        clusters: record.clusters,
        share: record.share,
        has_region: record.settings.region.is_some(),
        lacks_export: false,
        note: note.clone(),
        anew: false,
        known,
    })
}

/// Waits for the on_target command and logs its exit status.
fn wait_for(mut command: Child, project: &Path) {
    match command.wait() {
        Ok(status) if status.success() => {
            info!(project = %project.display(), "on_target command succeeded")
        }
        Ok(status) => warn!(project = %project.display(), %status, "on_target command failed"),
        Err(error) => {
            warn!(project = %project.display(), %error, "lost track of the on_target command")
        }
    }
}

/// Plans around the finished depth maps. Without view clusters the project is incomplete.
fn planned(project: &Project, settings: &Settings, job: &Job) -> StepResult<Plan> {
    let plan = planning::plan(project, settings, &JobWatcher::new(job)).map_err(sort_out)?;
    let plan = around_finished(plan, project, job)?;
    match EmptyPlan::detect(&plan) {
        None => Ok(plan),
        // Like an incomplete model: only other input can give more.
        Some(empty) => Err(Outcome::Incomplete {
            reason: empty.to_string(),
        }),
    }
}

/// Returns the plan around the finished depth maps of its predecessor (method 5.4), if there are
/// any.
fn around_finished(plan: Plan, project: &Project, job: &Job) -> StepResult<Plan> {
    let backend = plan.stages.backend;
    let Some(folder) = own_folder(project, backend, job.maps) else {
        return Ok(plan);
    };
    let earlier = match EarlierPlan::read(project) {
        Ok(earlier) => earlier,
        Err(WrittenPlanError::Io { source, .. }) if source.kind() != io::ErrorKind::NotFound => {
            return Err(unreadable(source));
        }
        Err(error @ WrittenPlanError::Own(_)) => return Err(failed(error)),
        // Without an earlier plan the partners of the maps are unknown.
        Err(_) => return Ok(plan),
    };
    if earlier.backend != backend {
        return Ok(plan);
    }
    let maps = MapFolder {
        folder: &folder,
        ready: &|path| job.maps.contains_key(path),
        known: &known_maps(backend, &folder),
    };
    match replan(plan, &earlier, &maps, &JobWatcher::new(job)) {
        Ok((plan, _)) => Ok(plan),
        Err(ReplanError::Plan(error)) => Err(sort_out(error)),
        // A plan without the maps would lose their partners, and outdated maps would count as good.
        Err(error) => Err(failed(error)),
    }
}

/// Warnings of a plan that was written, and exports that it lacks.
struct Written {
    warnings: Vec<String>,
    /// Why there is no export for some of the backends that the settings name.
    missing: Vec<String>,
}

/// Writes the plan, with the record of its input unless that has changed meanwhile.
fn write(
    plan: &Plan,
    project: &Project,
    mut record: PlannedFrom,
    job: &Job,
    disk: &Disk,
) -> StepResult<Written> {
    let files::PlanFiles {
        manifest,
        mut sets,
        not_exported,
        outdated_exports,
        outdated_flight,
        ..
    } = files::files(plan, project).map_err(failed)?;
    record.list_files(&sets, job.project);
    // Nobody asked for the export of a backend that was chosen for the project.
    let is_asked = !record.settings.backends.is_empty();
    let missing = not_exported.into_iter().filter(|_| is_asked);
    let missing: Vec<String> = missing.collect();
    record.lacks_export = !missing.is_empty();
    let record = serde_json::to_string(&record).map_err(|_| Outcome::Abandoned)?;
    if let Some(own) = sets.first_mut().filter(|_| job.is_current()) {
        own.add_text(RECORD, record + "\n");
    }
    if !job.is_wanted() {
        return Err(Outcome::Abandoned);
    }
    // The record is in the first set, whose root comes last: without it the plan is made again.
    output::write_all(&sets, disk).map_err(failed)?;
    let outdated: Vec<String> = outdated_exports
        .into_iter()
        .chain(outdated_flight)
        .collect();
    Ok(Written {
        warnings: warnings_with(&manifest.warnings, &manifest.exports, &outdated),
        missing,
    })
}

/// Says so if the plan differs from the one made by hand whose place it takes: options that were
/// typed for that are not in the settings.
fn another_than(plan: &Plan, project: &Project) -> Option<String> {
    let earlier = RecordedPlan::read(project).ok()?;
    let ranked = plan.ranked().take(plan.decision.cut.clusters);
    let list: Vec<_> = ranked
        .map(|c| (plan.stages.scene.name(c.key).to_owned(), c.scale))
        .collect();
    let before = earlier
        .clusters
        .iter()
        .take(earlier.cut.clusters)
        .map(|c| (c.key.clone(), c.scale));
    let is_same = earlier.backend == plan.stages.backend && before.eq(list);
    let backend = &earlier.backend;
    let chosen = chosen_for(backend, earlier.cut.clusters);
    let dropped = earlier.settings.typed.iter();
    let dropped: String = dropped.map(|option| format!(" {option}")).collect();
    let dropped = if dropped.is_empty() {
        dropped
    } else {
        format!(", typed with{dropped}")
    };
    (!is_same).then(|| {
        format!(
            "takes the place of a plan made by hand for {backend} ({chosen}{dropped}): lasting options belong in viewrank.toml"
        )
    })
}

/// Outcome of a read error. A file that vanishes while it is hashed is a change, which raises its
/// own event.
fn unreadable(error: io::Error) -> Outcome {
    match error.kind() {
        io::ErrorKind::NotFound => Outcome::Abandoned,
        _ => Outcome::Failed {
            reason: format!("cannot read input files: {error}"),
            hint: None,
        },
    }
}

/// Outcome of a model that can't be opened: incomplete if it doesn't parse or its files contradict
/// each other, failed on read errors.
fn incomplete(error: ProjectError) -> Outcome {
    match error {
        ProjectError::Io { ref source, .. } if is_read_error(source) => failed(error),
        error => Outcome::Incomplete {
            reason: error.to_string(),
        },
    }
}

/// True for errors other than missing or invalid files.
fn is_read_error(error: &io::Error) -> bool {
    !matches!(
        error.kind(),
        io::ErrorKind::NotFound | io::ErrorKind::InvalidInput | io::ErrorKind::NotADirectory
    )
}

fn sort_out(error: PlanError) -> Outcome {
    match error {
        PlanError::Cancelled(_) => Outcome::Abandoned,
        PlanError::Project(error) => incomplete(error),
        PlanError::NoViews { .. } => Outcome::Incomplete {
            reason: error.to_string(),
        },
        PlanError::Refused { .. } => Outcome::Aside {
            reason: error.to_string(),
            hint: error.hint().as_ref().map(on_command_line),
        },
        error => failed(error),
    }
}

/// Forwards progress in steps of one percent, and requests to cancel.
struct JobWatcher<'a> {
    job: &'a Job<'a>,
    /// Stage and percent that were sent last.
    sent: [AtomicU8; 2],
}

impl<'a> JobWatcher<'a> {
    fn new(job: &'a Job<'a>) -> Self {
        Self {
            job,
            sent: [AtomicU8::new(u8::MAX), AtomicU8::new(u8::MAX)],
        }
    }
}

impl Watcher for JobWatcher<'_> {
    fn progress(&self, stage: Stage, done: u64, total: u64) {
        let percent = (100 * done.min(total) / total.max(1)) as u8;
        let same_stage = self.sent[0].swap(stage as u8, Ordering::Relaxed) == stage as u8;
        // Not within the condition below, whose `&&` would skip it at a new stage.
        let same_percent = self.sent[1].swap(percent, Ordering::Relaxed) == percent;
        if !(same_stage && same_percent) {
            let name = serde_json::to_value(stage).ok();
            (self.job.progress)(
                name.as_ref().and_then(|n| n.as_str()).unwrap_or("planning"),
                percent,
            );
        }
    }

    fn cancelled(&self) -> bool {
        self.job.is_cancelled()
    }

    fn most_memory(&self) -> Option<u64> {
        self.job.most_memory
    }
}
