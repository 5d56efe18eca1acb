//! A sparse model with its project.

use std::{path::PathBuf, sync::Arc};

use numpy::{PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArray};
use pyo3::prelude::*;
use tempfile::TempDir;
use viewrank::{
    CreateError, Intrinsics, Project, Scene, SceneArrays,
    output::{self, Disk},
};

use crate::{
    arrays::{rows, view},
    failure::Failure,
    run::Runner,
};

/// A sparse model; `viewrank.Scene` wraps it.
#[pyclass(frozen, module = "viewrank._viewrank")]
pub struct Model(Arc<Held>);

/// A project, its scene, and its folder if that is temporary.
pub struct Held {
    pub project: Project,
    pub scene: Scene,
    pub temporary: Option<TempDir>,
}

impl Model {
    fn of(project: Project, temporary: Option<TempDir>) -> Result<Self, Failure> {
        let scene = project.read_scene()?;
        Ok(Self(Arc::new(Held {
            project,
            scene,
            temporary,
        })))
    }

    pub fn held(&self) -> Arc<Held> {
        self.0.clone()
    }
}

/// A camera as Python gives it: model, width, height, parameters.
type GivenCamera = (String, u64, u64, Vec<f64>);

#[pymethods]
impl Model {
    /// Reads the sparse model of a project. `images`: the image folder, if it is not found beside
    /// the model.
    #[staticmethod]
    fn read(
        py: Python<'_>,
        project: PathBuf,
        model: Option<String>,
        images: Option<PathBuf>,
        runner: Runner,
    ) -> PyResult<Self> {
        runner.run(py, |_| {
            let project = Project::open(&project, model.as_deref())?;
            // Absolute, because Python may change the current folder while the model lives.
            let images = images.map(|images| std::path::absolute(&images).unwrap_or(images));
            Self::of(project.with_images(images.as_deref()), None)
        })
    }

    /// Makes a model of what `write` writes to a folder in COLMAP's format, in `folder` or in a
    /// temporary folder.
    #[staticmethod]
    fn written_by(
        py: Python<'_>,
        write: &Bound<'_, PyAny>,
        images: Option<PathBuf>,
        folder: Option<PathBuf>,
        runner: Runner,
    ) -> PyResult<Self> {
        let (folder, temporary) = folder_or_temporary(folder)?;
        if folder.join("sparse").exists() {
            return Err(Failure::from(CreateError::OtherModel(folder)).into());
        }
        let model = folder.join("sparse/0");
        output::make_folder(&model, &Disk::REAL).map_err(Failure::from)?;
        write.call1((model.to_string_lossy(),))?;
        runner.run(py, |_| {
            let images = images.map(|images| std::path::absolute(&images).unwrap_or(images));
            if let Some(images) = &images {
                // COLMAP's own file: plans of this folder find the images by it, too.
                let path = model.join("project.ini");
                output::replace(
                    &path,
                    format!("image_path={}\n", images.display()).as_bytes(),
                    &Disk::REAL,
                )?;
            }
            let project = Project::open(&folder, None)?;
            Self::of(project.with_images(images.as_deref()), temporary)
        })
    }

    /// Makes a model of arrays in `folder`, or in a temporary folder.
    #[staticmethod]
    #[expect(
        clippy::too_many_arguments,
        reason = "one per array; the Python side names them"
    )]
    fn from_arrays(
        py: Python<'_>,
        names: Vec<String>,
        cameras: Vec<GivenCamera>,
        camera: PyReadonlyArray1<'_, i64>,
        cam_from_world: PyReadonlyArray2<'_, f64>,
        points: PyReadonlyArray2<'_, f64>,
        observations: PyReadonlyArray2<'_, i64>,
        pixels: PyReadonlyArray2<'_, f64>,
        images: Option<PathBuf>,
        folder: Option<PathBuf>,
        runner: Runner,
    ) -> PyResult<Self> {
        // A negative index becomes one that no list has, and is refused with the others.
        let index = |i: i64| usize::try_from(i).unwrap_or(usize::MAX);
        let arrays = SceneArrays {
            cameras: cameras
                .into_iter()
                .map(|(model, width, height, params)| Intrinsics {
                    model,
                    width,
                    height,
                    params,
                })
                .collect(),
            names,
            camera: camera.as_slice()?.iter().map(|&i| index(i)).collect(),
            cam_from_world: bytemuck::cast_slice(cam_from_world.as_slice()?).to_vec(),
            points: bytemuck::cast_slice(points.as_slice()?).to_vec(),
            observations: observations
                .as_slice()?
                .chunks(2)
                .map(|row| [index(row[0]), index(row[1])])
                .collect(),
            pixels: bytemuck::cast_slice(pixels.as_slice()?).to_vec(),
        };
        runner.run(py, |_| {
            let scene = Scene::from_arrays(&arrays)?;
            let (folder, temporary) = folder_or_temporary(folder)?;
            let project = Project::create(&folder, &scene, images.as_deref())?;
            // As a project on disk is read, so that the plan is that of the program.
            Self::of(project, temporary)
        })
    }

    /// Folder of the project; `None` where it is temporary.
    #[getter]
    fn folder(&self) -> Option<PathBuf> {
        self.0
            .temporary
            .is_none()
            .then(|| self.0.project.root.clone())
    }

    #[getter]
    fn images(&self) -> Option<PathBuf> {
        self.0
            .project
            .images
            .as_ref()
            .map(|folder| folder.to_path_buf())
    }

    #[getter]
    fn names(&self) -> Vec<&str> {
        self.0
            .scene
            .views
            .iter()
            .map(|view| view.name.as_str())
            .collect()
    }

    /// Model, width, height and parameters of each camera.
    #[getter]
    fn cameras(&self) -> Vec<(&'static str, u32, u32, Vec<f64>)> {
        let cameras = self.0.scene.cameras.iter();
        cameras
            .map(|c| (c.model().name(), c.width, c.height, c.params().to_vec()))
            .collect()
    }

    #[getter]
    fn camera(&self) -> Vec<usize> {
        self.0
            .scene
            .views
            .iter()
            .map(|view| view.camera.index())
            .collect()
    }

    /// Views x 12: `[R | t]` row by row.
    fn cam_from_world<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let row = |view: &viewrank::View| {
            let pose = view.cam_from_world;
            let row = |i: usize| {
                [0, 1, 2]
                    .map(|j| pose.rotation[(i, j)])
                    .into_iter()
                    .chain([pose.translation[i]])
            };
            (0..3).flat_map(row).collect()
        };
        let table: Vec<Vec<f64>> = self.0.scene.views.iter().map(row).collect();
        if table.is_empty() {
            // `from_vec2` takes the number of columns from the first row.
            return Ok(PyArray2::zeros(py, [0, 12], false));
        }
        Ok(PyArray2::from_vec2(py, &table)?)
    }

    fn points<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        rows::<f64>(slf, &slf.get().0.scene.points, 3)
    }

    fn point_ids<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        view(slf, &slf.get().0.scene.point_ids)
    }

    fn colours<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        rows::<u8>(slf, &slf.get().0.scene.colours, 3)
    }

    fn track_offsets<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        view(slf, &slf.get().0.scene.track_offsets)
    }

    fn track_views(&self) -> Vec<u32> {
        self.0.scene.track_views.iter().map(|view| view.0).collect()
    }

    fn track_pixels<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyUntypedArray>> {
        rows::<f64>(slf, &slf.get().0.scene.track_pixels, 2)
    }

    #[getter]
    fn unregistered(&self) -> Vec<String> {
        self.0.scene.unregistered.clone()
    }

    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.0
            .scene
            .warnings
            .iter()
            .map(|warning| warning.text.clone())
            .collect()
    }
}

/// The folder, else a new one that is removed with the model.
fn folder_or_temporary(folder: Option<PathBuf>) -> Result<(PathBuf, Option<TempDir>), Failure> {
    if let Some(folder) = folder {
        return Ok((folder, None));
    }
    let folder = tempfile::Builder::new().prefix("viewrank-").tempdir();
    let folder = folder.map_err(|source| viewrank::ProjectError::Io {
        path: std::env::temp_dir(),
        source,
    })?;
    Ok((folder.path().into(), Some(folder)))
}
