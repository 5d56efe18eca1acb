//! How many projects are planned at once: by jobs and by memory; and at what priority.

use std::path::Path;

/// Memory that planning needs beside what grows with the model.
const BASE_BYTES: u64 = 100 << 20;
/// Peak memory of a plan over the bytes of its model files (`benches/plan.py` prints both).
const BYTES_PER_MODEL_BYTE: u64 = 10;

/// Bytes of memory that planning a model of so many bytes needs at its peak.
pub fn need(model_bytes: u64) -> u64 {
    BASE_BYTES.saturating_add(model_bytes.saturating_mul(BYTES_PER_MODEL_BYTE))
}

/// The jobs that run. First come, first served: while one waits for memory, nobody that came later begins, for smaller ones would
/// overtake it for ever.
#[derive(Debug)]
pub struct Queue {
    jobs: usize,
    max_memory: u64,
    /// Number and need of each.
    running: Vec<(u64, u64)>,
    /// Does the line wait for memory?
    held: bool,
}

/// Why a project can't start now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Full {
    /// As many run as may.
    Jobs,
    /// It would fit when others end.
    Memory,
    /// It would not fit alone: needed and allowed bytes.
    Never { need: u64, max: u64 },
}

impl Queue {
    pub fn new(jobs: usize, max_memory: u64) -> Self {
        Self { jobs: jobs.max(1), max_memory, running: Vec::new(), held: false }
    }

    /// All that want to begin will ask in the order in which they came.
    pub fn call_up(&mut self) {
        self.held = false;
    }

    /// Lets the job of that number begin, or says why not.
    pub fn admit(&mut self, job: u64, need: u64) -> Result<(), Full> {
        let used: u64 = self.running.iter().map(|(_, need)| need).sum();
        if need > self.max_memory {
            return Err(Full::Never { need, max: self.max_memory });
        }
        if self.running.len() >= self.jobs {
            return Err(Full::Jobs);
        }
        self.held |= used + need > self.max_memory;
        if self.held {
            return Err(Full::Memory);
        }
        self.running.push((job, need));
        Ok(())
    }

    pub fn release(&mut self, job: u64) {
        self.running.retain(|(running, _)| *running != job);
    }

    pub fn is_idle(&self) -> bool {
        self.running.is_empty()
    }
}

/// `IOPRIO_WHO_PROCESS` and the idle-most level of the best-effort class (`ioprio_set(2)`).
const IO_THIS_PROCESS: libc::c_int = 1;
const IO_BEST_EFFORT_LOWEST: libc::c_int = (2 << 13) | 7;

/// Lowers the CPU and I/O priority of this process and of the threads that it starts from now on. Where the system refuses,
/// work goes on at the priority that there is.
pub fn lower_priority() {
    // SAFETY: both calls take plain numbers and change nothing but priorities.
    unsafe {
        libc::setpriority(libc::PRIO_PROCESS, 0, 10);
        libc::syscall(libc::SYS_ioprio_set, IO_THIS_PROCESS, 0, IO_BEST_EFFORT_LOWEST);
    }
}

/// Bytes of memory of this machine (or of the control group that it runs in, where that is less).
pub fn machine_memory() -> u64 {
    // SAFETY: `sysconf` takes and gives plain numbers.
    let (pages, size) = unsafe { (libc::sysconf(libc::_SC_PHYS_PAGES), libc::sysconf(libc::_SC_PAGE_SIZE)) };
    let machine = u64::try_from(pages).unwrap_or(0).saturating_mul(u64::try_from(size).unwrap_or(0));
    group_memory(Path::new("/proc/self/cgroup"), Path::new("/sys/fs/cgroup"))
        .map_or(machine, |group| group.min(machine))
}

/// The least `memory.max` of the control group (version 2) that `own` names and of those around it, which lie below `groups`.
fn group_memory(own: &Path, groups: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(own).ok()?;
    let name = text.lines().find_map(|line| line.strip_prefix("0::/"))?;
    let around = Path::new(name).ancestors().map(|group| groups.join(group).join("memory.max"));
    around.filter_map(|file| std::fs::read_to_string(file).ok()?.trim().parse().ok()).min()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jobs_and_memory_bound_what_runs_at_once() {
        let mut queue = Queue::new(2, 100);
        assert_eq!(queue.admit(1, 60), Ok(()));
        assert_eq!(queue.admit(2, 40), Ok(()));
        assert_eq!(queue.admit(3, 0), Err(Full::Jobs));
        queue.release(1);
        assert_eq!(queue.admit(3, 60), Ok(()));
        assert_eq!(queue.admit(4, 101), Err(Full::Never { need: 101, max: 100 }));
    }

    #[test]
    fn small_ones_do_not_overtake_a_large_one_that_waits_for_memory() {
        let mut queue = Queue::new(9, 100);
        let (first, large, never, small) = (1, 2, 3, 4);
        assert_eq!(queue.admit(first, 60), Ok(()));
        queue.call_up();
        assert_eq!(queue.admit(large, 90), Err(Full::Memory));
        assert_eq!(queue.admit(never, 101), Err(Full::Never { need: 101, max: 100 }));
        assert_eq!(queue.admit(small, 10), Err(Full::Memory));
        queue.release(first);
        queue.call_up();
        assert_eq!(queue.admit(large, 90), Ok(()));
        assert_eq!(queue.admit(small, 10), Ok(()));
    }

    #[test]
    fn the_tightest_of_the_control_groups_around_counts() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let own = root.path().join("own");
        std::fs::write(&own, "0::/system.slice/viewrank.service\n").expect("a file");
        assert_eq!(group_memory(&own, root.path()), None);
        for (group, max) in [("system.slice/viewrank.service", "max"), ("system.slice", "300"), (".", "500")] {
            std::fs::create_dir_all(root.path().join(group)).expect("a folder");
            std::fs::write(root.path().join(group).join("memory.max"), format!("{max}\n")).expect("a file");
        }
        assert_eq!(group_memory(&own, root.path()), Some(300));
    }
}
