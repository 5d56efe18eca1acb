//! Errors of the library as exceptions of `viewrank._errors`.

use std::path::PathBuf;

use pyo3::{exceptions::PyRuntimeError, prelude::*};
use viewrank::{
    ArraysError, CreateError, Hint, PlanError, ProjectError, backends::BackendError, config,
    evaluate::EvaluateError, files::FilesError, manifest::WrittenPlanError, output::OutputError,
    replan::RepeatError, report::ReportError,
};

/// An error on its way to Python.
#[derive(Debug)]
pub struct Failure {
    /// Name of the exception.
    exception: &'static str,
    message: String,
    hint: Option<String>,
    path: Option<PathBuf>,
}

impl Failure {
    fn new(exception: &'static str, error: &dyn Hint) -> Self {
        let exception = if error.is_usage() {
            "SettingsError"
        } else {
            exception
        };
        Self {
            exception,
            message: error.to_string(),
            hint: error.hint().as_ref().map(crate::options::as_keywords),
            path: error.path().map(Into::into),
        }
    }

    /// A plan of a model in memory that has no folder.
    pub fn without_folder() -> Self {
        Self {
            exception: "WriteError",
            message: "cannot write the plan: its model has no folder".into(),
            hint: Some("give plan() a folder= for the model and its plan".into()),
            path: None,
        }
    }

    /// The value as JSON.
    pub fn json(value: &impl serde::Serialize) -> Result<String, Self> {
        serde_json::to_string(value).map_err(|error| Self {
            exception: "Error",
            message: format!("cannot convert the result: {error}"),
            hint: None,
            path: None,
        })
    }
}

impl From<Failure> for PyErr {
    fn from(failure: Failure) -> Self {
        Python::attach(|py| {
            let class = py
                .import("viewrank._errors")
                .and_then(|module| module.getattr(failure.exception));
            let error =
                class.and_then(|class| class.call1((&failure.message, failure.hint, failure.path)));
            error.map_or_else(
                // The message must arrive even if the Python part of the package cannot be
                // imported.
                |_| PyRuntimeError::new_err(failure.message),
                PyErr::from_value,
            )
        })
    }
}

impl From<PlanError> for Failure {
    fn from(error: PlanError) -> Self {
        let exception = if matches!(error, PlanError::Project(_)) {
            "ReadError"
        } else {
            "PlanError"
        };
        Self::new(exception, &error)
    }
}

impl From<RepeatError> for Failure {
    fn from(error: RepeatError) -> Self {
        match error {
            RepeatError::Plan(error) => error.into(),
            RepeatError::Written(error) => error.into(),
            error => Self::new("PlanError", &error),
        }
    }
}

impl From<FilesError> for Failure {
    fn from(error: FilesError) -> Self {
        match error {
            FilesError::Backend(error) => error.into(),
            FilesError::Project(error) => error.into(),
            error => Self::new("WriteError", &error),
        }
    }
}

macro_rules! failures {
    ($($error:ty => $exception:literal),* $(,)?) => {
        $(impl From<$error> for Failure {
            fn from(error: $error) -> Self {
                Self::new($exception, &error)
            }
        })*
    };
}

failures! {
    ArraysError => "ReadError",
    BackendError => "ExportError",
    CreateError => "WriteError",
    config::ConfigError => "SettingsError",
    config::UnknownBackend => "SettingsError",
    EvaluateError => "EvaluateError",
    OutputError => "WriteError",
    ProjectError => "ReadError",
    ReportError => "EvaluateError",
    WrittenPlanError => "ReadError",
}
