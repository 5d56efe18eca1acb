//! Projects as programs and people leave them: which model is taken, which images it finds, what is
//! made of half a model, and what is said where nothing can be made of it.

mod counted;
mod files;
mod images;
mod models;
mod parts;
mod undistorted;
mod words;

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use tempfile::TempDir;
use viewrank_core::{
    method::synthetic::Town,
    model::{
        camera::{Camera, CameraModel},
        scene::{Scene, WarningKind},
    },
};
use viewrank_io::{
    formats::{
        colmap::{ColmapImage, ColmapModel, ImageUse},
        colmap_bin, colmap_text,
    },
    project::Project,
};

/// Nine views straight down, of 100 by 75 pixels.
pub fn scene() -> Scene {
    let params = vec![85.0, 85.0, 50.0, 37.5];
    let camera = Camera::new(1, CameraModel::Pinhole, 100, 75, params).unwrap();
    let mut scene = Town {
        grid: 3,
        tilt: None,
        side: 50.0,
        points: 500,
        ..Town::new(camera)
    }
    .scene();
    for (n, view) in scene.views.iter_mut().enumerate() {
        view.name = format!("view_{n}.png");
    }
    scene
}

/// A folder of files to come.
pub struct Folder(TempDir);

impl Folder {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn path(&self) -> &Path {
        self.0.path()
    }

    pub fn at(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> &Self {
        let path = self.at(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
        self
    }

    /// Pictures of the views under names of their own.
    pub fn pictures(&self, scene: &Scene, name: impl Fn(&str) -> String) -> &Self {
        let mut picture = std::io::Cursor::new(Vec::new());
        let grey = image::GrayImage::from_fn(100, 75, |x, y| image::Luma([(x * y) as u8]));
        grey.write_to(&mut picture, image::ImageFormat::Png)
            .unwrap();
        for view in &scene.views {
            self.write(&name(&view.name), picture.get_ref());
        }
        self
    }

    /// A binary COLMAP model.
    pub fn colmap(&self, folder: &str, model: &ColmapModel) -> &Self {
        for (name, bytes) in colmap_bin::write(model) {
            self.write(&format!("{folder}/{name}"), bytes);
        }
        self
    }

    fn colmap_text(&self, folder: &str, model: &ColmapModel) -> &Self {
        for (name, bytes) in colmap_text::write(model).unwrap() {
            self.write(&format!("{folder}/{name}"), bytes);
        }
        self
    }

    fn cloud(&self, name: &str, scene: &Scene) -> &Self {
        let head = format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
            scene.points.len()
        );
        let points = scene
            .points
            .iter()
            .map(|p| format!("{} {} {}\n", p.x, p.y, p.z));
        self.write(name, head + &points.collect::<String>())
    }

    fn open(&self) -> Project {
        let opened = Project::open(self.path(), None);
        opened.unwrap_or_else(|error| panic!("{error}"))
    }

    fn read(&self) -> Scene {
        self.open()
            .read_scene()
            .unwrap_or_else(|error| panic!("{error}"))
    }

    /// Plans without comparing pictures; exit code, stdout and stderr.
    pub fn plan(&self, options: &[&str]) -> (i32, String, String) {
        let path = self.path().to_str().unwrap();
        let arguments = ["plan", path, "--confidence", "geometric"];
        said(&viewrank(&[&arguments, options].concat()))
    }
}

/// Runs the program with nobody's own settings.
pub fn viewrank(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_viewrank"))
        .args(arguments)
        .env("XDG_CONFIG_HOME", env!("CARGO_TARGET_TMPDIR"))
        .output()
        .unwrap()
}

pub fn said(output: &Output) -> (i32, String, String) {
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    let code = output.status.code().unwrap();
    (code, text(&output.stdout), text(&output.stderr))
}

fn names(scene: &Scene) -> Vec<&str> {
    scene.views.iter().map(|view| view.name.as_str()).collect()
}

fn kinds(scene: &Scene) -> Vec<WarningKind> {
    scene.warnings.iter().map(|warning| warning.kind).collect()
}
