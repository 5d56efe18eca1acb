//! Bounds the plans that are made at the same time, by number and by memory.

/// Memory in bytes that planning needs for a model of any size.
const BASE_BYTES: u64 = 100 << 20;
/// Ratio of a plan's peak memory to the size of its model files (`benches/plan.py` prints both).
const BYTES_PER_MODEL_BYTE: u64 = 10;

/// Estimates the peak memory in bytes of planning a model of `model_bytes` bytes.
pub fn need(model_bytes: u64) -> u64 {
    BASE_BYTES.saturating_add(model_bytes.saturating_mul(BYTES_PER_MODEL_BYTE))
}

/// The running jobs. First come, first served: while a job waits for memory, no later one starts,
/// because small jobs would overtake a large one forever.
#[derive(Debug)]
pub struct JobQueue {
    jobs: usize,
    max_memory: u64,
    /// Number and memory need in bytes of each job.
    running: Vec<(u64, u64)>,
    /// A job ahead waits for memory.
    blocked: bool,
}

/// The reason why a job can't start now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Full {
    /// The number of jobs is at its limit.
    Jobs,
    /// The job waits until others have ended.
    Memory,
}

impl JobQueue {
    pub fn new(jobs: usize, max_memory: u64) -> Self {
        Self {
            jobs: jobs.max(1),
            max_memory,
            running: Vec::new(),
            blocked: false,
        }
    }

    /// Begins a round of calls to `admit`, in the order in which the jobs became due.
    pub fn begin_round(&mut self) {
        self.blocked = false;
    }

    /// Admits a job that needs `need` bytes, or returns the reason why it can't start. One that
    /// needs more than all runs alone: the estimate may be too high, and its forecast decides.
    pub fn admit(&mut self, job: u64, need: u64) -> Result<(), Full> {
        let used: u64 = self.running.iter().map(|(_, need)| need).sum();
        if self.running.len() >= self.jobs {
            return Err(Full::Jobs);
        }
        self.blocked |= used.saturating_add(need) > self.max_memory && !self.running.is_empty();
        if self.blocked {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn running_jobs_are_bounded_by_number_and_memory() {
        let mut queue = JobQueue::new(2, 100);
        assert_eq!(queue.admit(1, 60), Ok(()));
        assert_eq!(queue.admit(2, 40), Ok(()));
        assert_eq!(queue.admit(3, 0), Err(Full::Jobs));
        queue.release(1);
        assert_eq!(queue.admit(3, 60), Ok(()));
        queue.release(2);
        assert_eq!(queue.admit(4, u64::MAX), Err(Full::Memory));
        queue.release(3);
        queue.begin_round();
        assert_eq!(queue.admit(4, u64::MAX), Ok(()), "it runs alone");
        assert_eq!(queue.admit(5, 0), Err(Full::Memory));
    }

    #[test]
    fn small_jobs_do_not_overtake_a_large_one_that_waits_for_memory() {
        let mut queue = JobQueue::new(9, 100);
        let (first, large, small) = (1, 2, 3);
        assert_eq!(queue.admit(first, 60), Ok(()));
        queue.begin_round();
        assert_eq!(queue.admit(large, 90), Err(Full::Memory));
        assert_eq!(queue.admit(small, 10), Err(Full::Memory));
        queue.release(first);
        queue.begin_round();
        assert_eq!(queue.admit(large, 90), Ok(()));
        assert_eq!(queue.admit(small, 10), Ok(()));
    }
}
