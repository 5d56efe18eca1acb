//! Section `dispatch`: settings of `viewrank dispatch`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Bytes, TimeSpan};

/// Resources that `viewrank dispatch` requests for each view cluster. They don't affect plans:
/// manifests hold the defaults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DispatchSettings {
    /// Partition of the queue. Unset: the queue's default.
    pub partition: Option<String>,
    /// Account that the work is charged to.
    pub account: Option<String>,
    /// Quality of service.
    pub qos: Option<String>,
    /// Time limit of a depth map ("2h").
    pub time: Option<TimeSpan>,
    /// Memory of a task ("8G").
    pub memory: Option<Bytes>,
    /// CPUs of a task, and threads of the backend.
    #[schemars(range(min = 1), extend("unit" = "CPUs"))]
    pub cpus: u32,
    /// GPUs of a task.
    #[schemars(range(min = 1), extend("unit" = "GPUs"))]
    pub gpus: Option<u32>,
    /// Largest number of tasks that run at once. Unset: the queue's limit.
    #[schemars(range(min = 1), extend("unit" = "tasks"))]
    pub at_once: Option<u32>,
    /// Further options of `sbatch`. In the user's own file only.
    #[schemars(extend("userOnly" = true))]
    pub options: Vec<String>,
    /// Lines of sh to run at the start of each task, such as "module load colmap". In the user's
    /// own file only.
    #[schemars(extend("userOnly" = true))]
    pub setup: String,
}

impl Default for DispatchSettings {
    fn default() -> Self {
        Self {
            partition: None,
            account: None,
            qos: None,
            time: None,
            memory: None,
            cpus: 1,
            gpus: None,
            at_once: None,
            options: Vec::new(),
            setup: String::new(),
        }
    }
}
