//! `viewrank predict`: pictures of the predicted success of matching.

use std::path::{Path, PathBuf};

use crate::config::CONFIDENCE_WORDS;
use crate::{
    apps::replan,
    base::error::Hint,
    io::output::{Contents, Disk, FileSet},
    method::confidence::{self, Image, Predictor, Proxy, TrainedModel, size_for_confidence},
    model::cluster::ViewCluster,
    show::{
        pictures::{confidence_picture, expected_success},
        tables,
    },
};
use clap::Args;
use rayon::prelude::*;

use super::{Failure, Format, json, print, progress::Progress};

/// Draw where a backend is expected to succeed.
///
/// For a planned PROJECT: each key view with its partners, by the plan's confidence. For single images: a prediction from each image alone.
/// Writes DIR/NAME.png, the image next to its confidence in colours with a legend, and DIR/NAME.npy, the confidence as float32 (rows x columns of a
/// grid that covers the image). Grey, or NaN: the view sees no surface there.
#[derive(Args)]
pub struct Arguments {
    /// Folder of a planned project, or images of one folder
    #[arg(required = true, value_name = "PROJECT|IMAGE")]
    inputs: Vec<PathBuf>,

    /// Folder for the pictures
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Source of confidence of single images: proxy, shipped or a model file [default: shipped if there is one, else proxy]
    #[arg(long, value_name = "SOURCE|FILE")]
    confidence: Option<String>,
    /// Don't list the written files
    #[arg(long, short)]
    quiet: bool,
    /// Format of the results on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Name, PNG and array of a prediction.
type PredictionFiles = (String, Vec<u8>, Vec<u8>);

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let predictions = match &arguments.inputs[..] {
        [project] if project.is_dir() => of_project(project, arguments)?,
        images => of_images(images, arguments)?,
    };
    let mut files = FileSet::new(&arguments.out, "predict");
    for (name, picture, raw) in predictions {
        if files.files.contains_key(&format!("{name}.png")) {
            return Err(Same(name).into());
        }
        files.add(format!("{name}.png"), Contents::Bytes(picture));
        files.add(format!("{name}.npy"), Contents::Bytes(raw));
    }
    files.write(&Disk::REAL)?;
    if arguments.quiet {
        return Ok(());
    }
    if arguments.format == Format::Json {
        let written: Vec<PathBuf> = files.files.keys().map(|name| arguments.out.join(name)).collect();
        return print(&json(&serde_json::json!({ "files": written })));
    }
    print(&files.files.keys().map(|name| format!("{}\n", arguments.out.join(name).display())).collect::<String>())
}

/// The chosen key views of the written plan.
fn of_project(project: &Path, arguments: &Arguments) -> Result<Vec<PredictionFiles>, Failure> {
    if let Some(source) = &arguments.confidence {
        return Err(OfPlan(source.clone()).into());
    }
    let progress = Progress::new(arguments.quiet);
    let (project, plan, _) = replan::as_written(project, &progress)?;
    progress.finish();
    let folder = project.images.as_ref().ok_or(NoImages)?;
    let model = plan.stages.model();
    let of_view = |cluster: &ViewCluster| {
        let name = plan.stages.scene.name(cluster.key);
        let image = read(&folder.file(name))?;
        let (width, height) = (image.width, image.height);
        let chances = expected_success(&model, cluster, width, height);
        let picture = confidence_picture(&image, |x, y| chances[(y * width + x) as usize]);
        let raw = chances.iter().map(|chance| chance.unwrap_or(f32::NAN));
        Ok((name.to_owned(), picture, tables::array(&[height as usize, width as usize], raw)))
    };
    plan.chosen().collect::<Vec<_>>().into_par_iter().map(of_view).collect()
}

fn of_images(images: &[PathBuf], arguments: &Arguments) -> Result<Vec<PredictionFiles>, Failure> {
    let predictor = predictor(arguments.confidence.as_deref())?;
    let of_image = |path: &PathBuf| {
        let image = read(path)?;
        let map = predictor.predict(&image).map;
        let share = |i: u32, n: u32| (f64::from(i) + 0.5) / f64::from(n);
        let at = |x, y| Some(map.value_at(share(x, image.width), share(y, image.height)));
        let raw = tables::array(&[map.rows as usize, map.columns as usize], map.values().collect::<Vec<f32>>());
        Ok((name(path), confidence_picture(&image, at), raw))
    };
    images.par_iter().map(of_image).collect()
}

fn read(path: &Path) -> Result<Image, Unreadable> {
    Image::read(path, size_for_confidence).map_err(|source| Unreadable { path: path.into(), source })
}

fn predictor(source: Option<&str>) -> Result<Box<dyn Predictor>, Failure> {
    let trained = match source {
        Some("proxy") => None,
        None | Some("shipped") => TrainedModel::shipped(),
        Some(word) if CONFIDENCE_WORDS.contains(&word) => return Err(NoPredictor(word.into()).into()),
        Some(file) => Some(TrainedModel::read(Path::new(file))?),
    };
    match trained {
        None => Ok(Box::new(Proxy)),
        Some(TrainedModel { picture: Some(picture), .. }) => Ok(Box::new(picture)),
        Some(_) => Err(NoPicture.into()),
    }
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
struct Unreadable {
    path: PathBuf,
    source: confidence::ImageError,
}

impl Hint for Unreadable {
    fn hint(&self) -> Option<String> {
        Some("give JPEG, PNG or TIFF images".into())
    }
}

#[derive(Debug, thiserror::Error)]
#[error("two images have the same name: {0}")]
struct Same(String);

impl Hint for Same {
    fn hint(&self) -> Option<String> {
        Some("give images of one folder at a time".into())
    }

    fn is_usage(&self) -> bool {
        true
    }
}

#[derive(Debug, thiserror::Error)]
#[error("a project's pictures show the confidence that it was planned with, not {0}")]
struct OfPlan(String);

impl Hint for OfPlan {
    fn hint(&self) -> Option<String> {
        Some("leave --confidence out, or give images instead of the project".into())
    }

    fn is_usage(&self) -> bool {
        true
    }
}

#[derive(Debug, thiserror::Error)]
#[error("the project has no image folder")]
struct NoImages;

impl Hint for NoImages {
    fn hint(&self) -> Option<String> {
        Some("put the images of the model into PROJECT/images".into())
    }
}

#[derive(Debug, thiserror::Error)]
#[error("cannot predict single images with {0}")]
struct NoPredictor(String);

impl Hint for NoPredictor {
    fn hint(&self) -> Option<String> {
        Some("give proxy, shipped or a model file that viewrank train has written".into())
    }

    fn is_usage(&self) -> bool {
        true
    }
}

#[derive(Debug, thiserror::Error)]
#[error("the model was trained without pictures")]
struct NoPicture;

impl Hint for NoPicture {
    fn hint(&self) -> Option<String> {
        Some("train with the images present, or pass --confidence proxy".into())
    }

    fn is_usage(&self) -> bool {
        true
    }
}
