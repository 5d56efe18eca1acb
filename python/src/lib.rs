//! The native part of the Python package `viewrank`: conversions between Python and the library,
//! nothing else. `python/viewrank` has the public names and their documentation.

mod arrays;
mod failure;
mod model;
mod options;
mod plan;
mod run;

use pyo3::prelude::*;

#[pymodule]
mod _viewrank {
    use std::{ffi::OsString, path::PathBuf};

    use pyo3::prelude::*;
    use viewrank::{Project, backends, doctor};

    use super::{failure::Failure, options, run::Runner};

    #[pymodule_export]
    use super::{model::Model, plan::Plan};

    #[pymodule_export]
    const VERSION: &str = env!("CARGO_PKG_VERSION");

    /// Runs the program with these arguments, the first of which is its name; returns its exit
    /// code.
    #[pyfunction]
    fn main(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
        py.detach(|| viewrank::cli::run_with(arguments) as u8)
    }

    /// Diagnoses a project; returns the `Diagnosis` of the program as JSON.
    #[pyfunction]
    fn doctor_json(
        py: Python<'_>,
        project: PathBuf,
        names: Vec<String>,
        model: Option<String>,
        runner: Runner,
    ) -> PyResult<String> {
        runner.run(py, |_| {
            let project = Project::open(&project, model.as_deref())?;
            let settings = options::load(&project.root, Default::default())?;
            let wanted = if names.is_empty() {
                &settings.backends
            } else {
                &names
            };
            let backends = doctor::backends_to_check(&project, wanted, names.is_empty())?;
            let scene = project.read_scene()?;
            Failure::json(&doctor::examine(&project, &scene, &settings, &backends))
        })
    }

    /// Names of all backends.
    #[pyfunction]
    fn backend_names() -> Vec<&'static str> {
        backends::BACKENDS
            .iter()
            .map(|backend| backend.name)
            .collect()
    }
}
