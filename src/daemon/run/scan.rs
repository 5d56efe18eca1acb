//! Scans of the roots: which are due, and what they find.

use std::{
    collections::{BTreeMap, BTreeSet},
    mem,
    path::{Path, PathBuf},
    time::{Duration, Instant, SystemTime},
};

use tracing::info;

use super::{Daemon, NETWORK_POLL};
use crate::{
    daemon::{
        WatchOptions,
        discover::{self, InputFolders},
        maps,
        settle::Stamp,
        state::TrackedProject,
        watch::Change,
    },
    io::depthmaps,
};

/// Changes within this time of the first one share a scan.
const GATHER: Duration = Duration::from_millis(50);
/// After a scan of changes the next one waits for this multiple of its duration, up to the settle
/// time and [`LONGEST_REST`].
const REST: u32 = 19;
const LONGEST_REST: Duration = Duration::from_secs(2);

/// Scans that are due.
pub(super) struct Scans {
    /// Projects in which something changed, with the time of the last event.
    projects: BTreeMap<PathBuf, Instant>,
    /// The last event outside projects: the roots must be searched for projects.
    search: Option<Instant>,
    everything: bool,
    /// Events were lost since the last scan of everything.
    lost: bool,
    gather_until: Option<Instant>,
    /// No scan of changes before this.
    rest_until: Instant,
    next_full: Instant,
}

impl Scans {
    pub fn new(now: Instant) -> Self {
        let (projects, search) = (BTreeMap::new(), None);
        Self {
            projects,
            search,
            // Before the first watches there are no events.
            everything: true,
            lost: false,
            gather_until: None,
            rest_until: now,
            next_full: now,
        }
    }

    pub fn add_everything(&mut self) {
        self.everything = true;
    }

    pub fn add_project(&mut self, project: PathBuf, now: Instant) {
        self.projects.insert(project, now);
        self.gather(now);
    }

    fn add_search(&mut self, now: Instant) {
        self.search = Some(now);
        self.gather(now);
    }

    fn gather(&mut self, now: Instant) {
        self.gather_until
            // The first change sets the time, or a steady writer would put the scan off forever.
            .get_or_insert((now + GATHER).max(self.rest_until));
    }

    pub fn is_empty(&self) -> bool {
        self.projects.is_empty() && self.search.is_none() && !self.everything
    }

    /// Returns when the next scan is due.
    pub fn due(&self) -> Instant {
        self.gather_until
            .map_or(self.next_full, |until| until.min(self.next_full))
    }
}

impl Daemon<'_> {
    /// Takes note of a file-system event.
    pub(super) fn note_change(&mut self, change: Change, now: Instant) {
        match change {
            Change::At(path) => self.note_path(&path, false, now),
            Change::Gone(path) => {
                self.watches.remove(&path);
                self.note_path(&path, true, now);
            }
            Change::Lost => {
                self.scans.lost = true;
                self.scans.add_everything();
            }
        }
    }

    fn note_path(&mut self, path: &Path, is_gone: bool, now: Instant) {
        let Some(project) = path
            .ancestors()
            .find(|above| self.projects.contains_key(*above))
        else {
            return self.note_outside(path, now);
        };
        if path.starts_with(project.join("images"))
            && let Some(tracked) = self.projects.get_mut(project)
        {
            tracked.disturb(now);
        }
        if !is_own_output(project, path, is_gone) {
            self.scans.add_project(project.into(), now);
        }
    }

    /// A change outside projects may make one, or move some.
    fn note_outside(&mut self, path: &Path, now: Instant) {
        let inside = self
            .roots
            .iter()
            .find_map(|root| path.strip_prefix(root).ok());
        if !inside.is_some_and(|inside| {
            inside
                .components()
                .all(|part| discover::is_searched(part.as_os_str()))
        }) {
            return;
        }
        // Folders inside one that was moved raise no events of their own.
        let moved = self
            .projects
            .range(path.to_path_buf()..)
            .map(|(project, _)| project);
        let moved = moved.take_while(|project| project.starts_with(path));
        self.scans
            .projects
            .extend(moved.map(|project| (project.clone(), now)));
        self.scans.add_search(now);
    }

    /// Scans what changed, or everything when it is time.
    pub(super) fn scan(&mut self, now: Instant) {
        if self.scans.everything || now >= self.scans.next_full {
            self.scan_everything(now);
        } else if self
            .scans
            .gather_until
            .is_some_and(|until| now >= until || self.is_job_due(now))
        {
            self.scan_changed(now);
            let ended = Instant::now();
            self.scans.rest_until = ended
                + ((ended - now) * REST)
                    .min(LONGEST_REST)
                    .min(self.options.settle);
        }
        if let Some(notice) = self.watches.notice() {
            self.status.notice(notice.clone());
        }
        // A root that is gone, or a watch that failed, shortens the pause.
        self.scans.next_full = self.scans.next_full.min(now + self.pause());
    }

    /// True if a job could start now. All known changes must be scanned before.
    fn is_job_due(&self, now: Instant) -> bool {
        let due = |tracked: &TrackedProject| {
            tracked
                .due(self.options.settle)
                .is_some_and(|(at, _)| at <= now)
        };
        self.projects
            .values()
            .any(|tracked| !tracked.is_queued() && due(tracked))
    }

    /// The longest time between two scans of everything.
    fn pause(&self) -> Duration {
        match self.poll {
            Some(poll) => poll,
            // No event reports a root that comes back.
            None if self.watches.needs_polling()
                || self.roots.iter().any(|root| !root.is_dir()) =>
            {
                NETWORK_POLL.min(self.options.rescan)
            }
            None => self.options.rescan,
        }
    }

    fn scan_everything(&mut self, now: Instant) {
        let lost = self.scans.lost;
        // Cleared before the search, which may add to it.
        self.scans = Scans {
            everything: false,
            rest_until: self.scans.rest_until,
            ..Scans::new(now)
        };
        self.status.begin_scan();
        if lost {
            self.status
                .notice("file events were lost; scanned everything".into());
        }
        if self.is_on_network {
            self.status
                .notice("network file system: polling the folders every 10 s (--poll)".into());
        }
        if self.poll.is_none() {
            self.watches.renew();
        }
        self.search(now);
        let projects: Vec<PathBuf> = self.projects.keys().cloned().collect();
        projects
            .iter()
            .for_each(|project| self.scan_project(project, None, now));
        self.scans.next_full = now + self.pause();
    }

    fn scan_changed(&mut self, now: Instant) {
        self.scans.gather_until = None;
        let mut projects = mem::take(&mut self.scans.projects);
        let search = self.scans.search.take();
        let is_project = |path: &PathBuf| discover::is_project(path, self.options.follow_links);
        if search.is_some() || !projects.keys().all(is_project) {
            let new = self.search(now);
            projects.extend(
                new.into_iter()
                    .map(|project| (project, search.unwrap_or(now))),
            );
        }
        projects
            .iter()
            .for_each(|(project, heard)| self.scan_project(project, Some(*heard), now));
    }

    /// Searches the roots for projects: forgets those that are gone, adds and returns the new ones.
    fn search(&mut self, now: Instant) -> BTreeSet<PathBuf> {
        let mut found = BTreeSet::new();
        for root in &self.roots {
            let walk = discover::walk(root, &self.roots, self.options.follow_links, &|| {
                self.supervisor.alive()
            });
            if self.watches.add(&walk.folders) {
                // Something may have changed between the walk and the watch.
                self.scans.add_search(now);
            }
            for (folder, reason) in walk.unreadable {
                self.status
                    .notice(format!("cannot read folder {}: {reason}", folder.display()));
            }
            found.extend(walk.projects);
        }
        let gone: Vec<PathBuf> = self
            .projects
            .keys()
            .filter(|project| !found.contains(*project))
            .cloned()
            .collect();
        gone.iter().for_each(|project| self.forget(project));
        found.retain(|project| !self.projects.contains_key(project));
        for project in &found {
            info!(project = %project.display(), "found");
            self.projects
                .insert(project.clone(), TrackedProject::new(project.clone(), now));
        }
        found
    }

    /// Compares a project with the last scan of it, and watches its folders. `heard` is the time of
    /// its last event, where known.
    fn scan_project(&mut self, project: &Path, heard: Option<Instant>, now: Instant) {
        // A scan of many projects may take longer than the watchdog waits.
        self.supervisor.alive();
        let Some(tracked) = self.projects.get_mut(project) else {
            return;
        };
        let WatchOptions {
            on_busy,
            follow_links,
            ..
        } = *self.options;
        let named = self.planner.named_files(project);
        let input = InputFolders::find(project, follow_links);
        let (map_folders, maps) = maps::scan(project, follow_links);
        let new_watches = self
            .watches
            .add(&folders_to_watch(project, &input, map_folders, &named));
        // Read after the watches are set, so that any later change raises an event.
        let stamp = Stamp::of_folders(&input).with(&named);
        let scanned = (Instant::now(), SystemTime::now());
        let since = heard.map_or(now, |heard| stamp.same_since(heard, scanned));
        tracked.observe(stamp, since, on_busy);
        match maps {
            Ok(maps) => tracked.observe_maps(maps, now),
            // Maps seen before may still be there.
            Err(unreadable) => self.status.notice(unreadable.to_string()),
        }
        if tracked.is_at_rest() && !self.planner.has_plan(project) {
            tracked.recheck();
        }
        if new_watches {
            // A folder may have come between the listing and the watch.
            self.scans.add_project(project.into(), now);
        }
    }

    /// Drops a project that is gone, or isn't one any more, and cancels its job.
    fn forget(&mut self, project: &Path) {
        info!(project = %project.display(), "gone");
        if let Some(tracked) = self.projects.remove(project) {
            tracked.cancel();
        }
        self.planner.forget(project);
    }
}

/// True for a path in the project's output folder that viewrank itself writes. Only files that were
/// removed and those of depth maps matter there.
fn is_own_output(project: &Path, path: &Path, is_gone: bool) -> bool {
    let Ok(inside) = path.strip_prefix(project.join(discover::OUTPUT_FOLDER)) else {
        return false;
    };
    let is_hidden = inside
        .components()
        .any(|part| part.as_os_str().as_encoded_bytes().starts_with(b"."));
    // Without an extension it may be a new folder of depth maps.
    is_hidden || !is_gone && path.extension().is_some() && !depthmaps::is_of_a_map(inside)
}

/// Folders whose changes concern the project; `named` are the files that it depends on besides
/// model and images.
fn folders_to_watch(
    project: &Path,
    input: &InputFolders,
    maps: Vec<PathBuf>,
    named: &[PathBuf],
) -> BTreeSet<PathBuf> {
    let own = project.join(discover::OUTPUT_FOLDER);
    let named = named
        .iter()
        .filter_map(|file| file.parent().map(Path::to_path_buf));
    // Files outside of the project are compared at the next scan of everything.
    let named = named.filter(|folder| folder.starts_with(project) && !folder.starts_with(&own));
    let mut folders: BTreeSet<PathBuf> = input.all().cloned().chain(maps).chain(named).collect();
    folders.extend(Some(own).filter(|own| own.is_dir()));
    folders
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_the_output_folder_only_depth_maps_and_removed_files_matter() {
        let own = |path: &str, is_gone| is_own_output(Path::new("/p"), Path::new(path), is_gone);
        assert!(own("/p/viewrank/clusters.txt", false) && !own("/p/viewrank/clusters.txt", true));
        assert!(own("/p/viewrank/.staging/clusters.txt", true) && own("/p/viewrank/.lock", false));
        assert!(
            !own("/p/viewrank/openmvs/depth0001.dmap", false) && !own("/p/viewrank/openmvs", false)
        );
        assert!(
            !own("/p/viewrank/micmac/MM-Malt-Img-a/Z_Num8.tif", false),
            "rewritten after the description"
        );
        assert!(
            !own("/p/viewrank/micmac/MM-Malt-Img-a/viewrank.recipe", false)
                && own("/p/viewrank/micmac/links.tif", false)
        );
        assert!(!own("/p/sparse/0/images.bin", false));
    }
}
