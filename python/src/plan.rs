//! A plan and what can be done with it.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use numpy::{PyArray1, PyUntypedArray};
use pyo3::{prelude::*, types::PyDict};
use viewrank::{
    Project, backends,
    backends::{ExportOptions, ExportRecord, References},
    evaluate::Evaluation,
    files,
    output::{self, Disk, FileSet},
    pictures, replan,
    report::{self, Contents, DepthMapFolders},
};

use crate::{
    arrays::{rows, view},
    failure::Failure,
    model::{Held, Model},
    options,
    run::Runner,
};

/// A plan; `viewrank.Plan` wraps it.
#[pyclass(frozen, module = "viewrank._viewrank")]
pub struct Plan(Arc<Planned>);

struct Planned {
    plan: viewrank::Plan,
    project: Project,
    /// Exports that the manifest of a written plan records.
    exports: Vec<ExportRecord>,
    /// The model of a plan that was not read from a folder of the user's; keeps a temporary folder.
    model: Option<Arc<Held>>,
}

impl Planned {
    fn is_temporary(&self) -> bool {
        self.model
            .as_ref()
            .is_some_and(|model| model.temporary.is_some())
    }
}

/// Fulfilment by the chosen clusters and by all, and chosen key views, by triangle.
type States<'py> = (
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray1<u16>>,
);

/// A cluster: key view, partners, gain, share.
type Ranked = (String, Vec<String>, f64, f64, f64);

#[pymethods]
impl Plan {
    /// Plans a model; `keywords` are those of `viewrank.plan` that are settings.
    #[staticmethod]
    fn new(
        py: Python<'_>,
        model: &Model,
        keywords: &Bound<'_, PyDict>,
        runner: Runner,
    ) -> PyResult<Self> {
        let typed = options::typed(keywords)?;
        let held = model.held();
        runner.run(py, move |watcher| {
            let settings = options::load(&held.project.root, typed)?;
            // A copy, since the same model may be planned again.
            let plan = viewrank::plan_scene(&held.project, held.scene.clone(), &settings, watcher)?;
            Ok(Self(Arc::new(Planned {
                plan,
                project: held.project.clone(),
                exports: Vec::new(),
                model: Some(held),
            })))
        })
    }

    /// The plan that was written to a project, with all its tables.
    #[staticmethod]
    fn load(py: Python<'_>, project: PathBuf, runner: Runner) -> PyResult<Self> {
        runner.run(py, |watcher| {
            let (project, plan, exports) = replan::as_written(&project, watcher)?;
            Ok(Self(Arc::new(Planned {
                plan,
                project,
                exports,
                model: None,
            })))
        })
    }

    #[getter]
    fn backend(&self) -> &'static str {
        self.0.plan.stages.backend
    }

    /// False for a backend that uses the images themselves.
    #[getter]
    fn makes_maps(&self) -> bool {
        self.0.plan.stages.makes_maps
    }

    /// Folder of the project; `None` where it is temporary.
    #[getter]
    fn folder(&self) -> Option<PathBuf> {
        (!self.0.is_temporary()).then(|| self.0.project.root.clone())
    }

    #[getter]
    fn names(&self) -> Vec<&str> {
        self.0
            .plan
            .stages
            .scene
            .views
            .iter()
            .map(|view| view.name.as_str())
            .collect()
    }

    #[getter]
    fn warnings(&self) -> Vec<String> {
        let scene = self
            .0
            .plan
            .stages
            .scene
            .warnings
            .iter()
            .map(|warning| warning.text.clone());
        scene.chain(self.0.plan.warnings.iter().cloned()).collect()
    }

    /// The settings in force, as JSON.
    fn settings(&self) -> PyResult<String> {
        Ok(Failure::json(&self.0.plan.stages.settings)?)
    }

    /// The cut, as JSON.
    fn cut(&self) -> PyResult<String> {
        Ok(Failure::json(&self.0.plan.decision.cut)?)
    }

    /// The whole ranking, best first.
    fn ranking(&self) -> Vec<Ranked> {
        let scene = &self.0.plan.stages.scene;
        let gains = &self.0.plan.decision.ranking.gains;
        let cluster = |(cluster, gain): (viewrank::RankedCluster, &f64)| {
            let partners = cluster
                .partners
                .iter()
                .map(|&view| scene.name(view).to_owned())
                .collect();
            (
                scene.name(cluster.key).to_owned(),
                partners,
                *gain,
                cluster.share,
                cluster.scale.factor(),
            )
        };
        self.0.plan.ranked().zip(gains).map(cluster).collect()
    }

    /// Columns of the curve, by name.
    fn curve<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let curve = py.detach(|| self.0.plan.curve());
        let columns = PyDict::new(py);
        let whole = |name: &str, value: fn(&viewrank::CurvePoint) -> usize| {
            columns.set_item(
                name,
                PyArray1::from_iter(py, curve.iter().map(|point| value(point) as i64)),
            )
        };
        whole("clusters", |point| point.clusters)?;
        whole("pairs", |point| point.pairs)?;
        let real = |name: &str, value: fn(&viewrank::CurvePoint) -> f64| {
            columns.set_item(name, PyArray1::from_iter(py, curve.iter().map(value)))
        };
        real("share", |point| point.share)?;
        real("kept", |point| point.kept)?;
        real("fulfilment", |point| point.fulfilment)?;
        real("points", |point| point.points)?;
        real("seconds", |point| point.seconds.unwrap_or(f64::NAN))?;
        Ok(columns)
    }

    fn vertices<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        rows::<f64>(slf, &slf.get().0.plan.stages.surface.vertices, 3)
    }

    fn triangles<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        rows::<u32>(slf, &slf.get().0.plan.stages.surface.triangles, 3)
    }

    /// Fulfilment of each triangle by the chosen clusters and by all, and the number of chosen key
    /// views that fulfil it.
    fn triangle_states<'py>(&self, py: Python<'py>, clusters: usize) -> States<'py> {
        let states = py.detach(|| pictures::triangle_states(&self.0.plan, clusters));
        (
            PyArray1::from_iter(py, states.iter().map(|state| state.fulfilment)),
            PyArray1::from_iter(py, states.iter().map(|state| state.reachable)),
            PyArray1::from_iter(py, states.iter().map(|state| state.chosen_views)),
        )
    }

    fn visibility_offsets<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        view(slf, slf.get().0.plan.stages.visibility.offsets.as_slice())
    }

    fn visibility_triangles<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        view(slf, &slf.get().0.plan.stages.visibility.triangles)
    }

    /// View of the key view of each row of the fulfilment table.
    fn fulfilment_keys(&self) -> Vec<u32> {
        self.0
            .plan
            .stages
            .clusters
            .iter()
            .map(|cluster| cluster.key.0)
            .collect()
    }

    fn fulfilment_offsets<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        view(slf, &slf.get().0.plan.stages.fulfilment.offsets)
    }

    fn fulfilment_triangles<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        view(slf, &slf.get().0.plan.stages.fulfilment.triangles)
    }

    fn fulfilment_values<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        view(slf, &slf.get().0.plan.stages.fulfilment.values)
    }

    /// Writes the plan to its project; returns the folder and the warnings.
    fn write(&self, py: Python<'_>, runner: Runner) -> PyResult<(PathBuf, Vec<String>)> {
        runner.run(py, |_| {
            if self.0.is_temporary() {
                return Err(Failure::without_folder());
            }
            let files = files::files_of_same_model(&self.0.plan, &self.0.project)?;
            let uncached = files.write(&self.0.project.disk())?;
            Ok((
                self.0.project.output_folder(),
                files
                    .manifest
                    .warnings
                    .into_iter()
                    .chain(uncached)
                    .collect(),
            ))
        })
    }

    /// Writes the files of a backend; returns their folder and the record of the export as JSON.
    #[expect(
        clippy::too_many_arguments,
        reason = "one per option; the Python side names them"
    )]
    fn export(
        &self,
        py: Python<'_>,
        backend: &str,
        out: Option<PathBuf>,
        clusters: usize,
        refs: Option<&str>,
        geometric: Option<bool>,
        scene: Option<PathBuf>,
        scale: bool,
        runner: Runner,
    ) -> PyResult<(PathBuf, String)> {
        let refs = match refs {
            None => None,
            Some("keys") => Some(References::Keys),
            Some("keys+partners") => Some(References::KeysAndPartners),
            Some("all") => Some(References::All),
            Some(other) => {
                let wanted =
                    format!("refs must be \"keys\", \"keys+partners\" or \"all\", not {other:?}");
                return Err(pyo3::exceptions::PyValueError::new_err(wanted));
            }
        };
        runner.run(py, |_| {
            if out.is_none() && self.0.is_temporary() {
                return Err(Failure::without_folder());
            }
            // The export reads the files of the model again.
            self.0.project.refuse_changed_model()?;
            let backend = backends::by_name(backend)?;
            let options = ExportOptions {
                out,
                refs,
                geometric,
                scene,
                scale,
            };
            let (folder, files, record) =
                files::export(&self.0.plan, &self.0.project, backend, clusters, &options)?;
            files.write(&self.0.project.disk())?;
            Ok((folder, Failure::json(&record)?))
        })
    }

    /// Writes the report page to `path`, else into the project; returns its path.
    fn report(
        &self,
        py: Python<'_>,
        path: Option<PathBuf>,
        depth_maps: Option<PathBuf>,
        reference: Option<PathBuf>,
        runner: Runner,
    ) -> PyResult<PathBuf> {
        runner.run(py, |watcher| {
            let Planned {
                plan,
                project,
                exports,
                ..
            } = &*self.0;
            let folders = DepthMapFolders {
                depth_maps,
                reference,
            };
            let contents = Contents::new(plan, project, exports, &folders, watcher)?;
            let page = report::page(&contents);
            let Some(path) = path else {
                if self.0.is_temporary() {
                    return Err(Failure::without_folder());
                }
                let mut files = FileSet::new(&project.home, files::REPORT_SET);
                files.add_text(files::REPORT_FILE, page);
                files.write(&project.disk())?;
                return Ok(files::report_path(&project.home));
            };
            output::replace(&path, page.as_bytes(), &Disk::REAL)?;
            Ok(path)
        })
    }

    /// Measures finished depth maps; returns the evaluation as JSON.
    fn evaluate(
        &self,
        py: Python<'_>,
        depth_maps: PathBuf,
        reference: Option<PathBuf>,
        baselines: bool,
        runner: Runner,
    ) -> PyResult<String> {
        runner.run(py, |watcher| {
            let reference = reference.as_deref().map(Path::new);
            let evaluation =
                Evaluation::of_plan(&self.0.plan, &depth_maps, reference, baselines, watcher)?;
            Failure::json(&evaluation)
        })
    }

    fn curve_svg(&self) -> String {
        pictures::curve_svg(&pictures::FulfilmentCurve::predicted(&self.0.plan))
    }

    fn map_svg(&self, py: Python<'_>) -> String {
        py.detach(|| pictures::map_svg(&self.0.plan))
    }
}
