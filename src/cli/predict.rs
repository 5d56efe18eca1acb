//! `viewrank predict`: pictures of the predicted success of matching.

use std::path::{Path, PathBuf};

use crate::{
    apps::replan,
    base::{
        error::{Advice, Hint},
        pixels::PixelBound,
    },
    io::{
        image::{Image, ImageError, drawn_size},
        npy,
        output::{Contents, Disk, FileSet},
    },
    model::cluster::ViewCluster,
    show::pictures::{confidence_picture, expected_success},
};
use clap::Args;
use rayon::prelude::*;

use super::{Failure, Format, print_json, print_sentences, progress::ProgressDisplay};

/// Draw where the backend is expected to succeed.
///
/// DIR gets two files for each chosen key view of the plan: NAME.png, the image beside the chance
/// that its depth map has a depth there, in colours with a legend, and NAME.npy, the chance as
/// float32 (rows x columns of the picture). Grey, or NaN: the view sees no surface there.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the planned project
    #[arg(value_name = "PROJECT")]
    project: PathBuf,

    /// Folder for the pictures
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Don't list the written files
    #[arg(long, short)]
    quiet: bool,
    /// Format of the list on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Name, PNG and array of a prediction.
type PredictionFiles = (String, Vec<u8>, Vec<u8>);

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let mut files = FileSet::new(&arguments.out, "predict");
    for (name, picture, raw) in predictions(&arguments.project, arguments)? {
        files.add(format!("{name}.png"), Contents::Bytes(picture));
        files.add(format!("{name}.npy"), Contents::Bytes(raw));
    }
    files.write(&Disk::REAL)?;
    if arguments.quiet {
        return Ok(());
    }
    if arguments.format == Format::Json {
        let written: Vec<PathBuf> = files
            .files
            .keys()
            .map(|name| arguments.out.join(name))
            .collect();
        return print_json(&serde_json::json!({ "files": written }));
    }
    print_sentences(
        files
            .files
            .keys()
            .map(|name| arguments.out.join(name).display().to_string()),
    )
}

/// The chosen key views of the written plan.
fn predictions(project: &Path, arguments: &Arguments) -> Result<Vec<PredictionFiles>, Failure> {
    let progress = ProgressDisplay::new(arguments.quiet);
    let (project, plan, _) = replan::as_written(project, &progress)?;
    progress.finish();
    let folder = project.images.as_ref().ok_or(NoImages)?;
    let model = plan.stages.model();
    let of_view = |cluster: &ViewCluster| {
        let name = plan.stages.scene.name(cluster.key);
        let bound = plan
            .stages
            .scene
            .camera_of(cluster.key)
            .most_picture_pixels();
        let image = read(&folder.file(name), bound)?;
        let (width, height) = (image.width, image.height);
        let chances = expected_success(&model, cluster, width, height);
        let picture = confidence_picture(&image, |x, y| chances[(y * width + x) as usize]);
        let raw = chances.iter().map(|chance| chance.unwrap_or(f32::NAN));
        Ok((
            name.to_owned(),
            picture,
            npy::write(&[height as usize, width as usize], raw),
        ))
    };
    plan.chosen()
        .collect::<Vec<_>>()
        .into_par_iter()
        .map(of_view)
        .collect()
}

fn read(path: &Path, bound: PixelBound) -> Result<Image, Unreadable> {
    Image::read(path, bound, drawn_size).map_err(|source| Unreadable {
        path: path.into(),
        source,
    })
}

#[derive(Debug, thiserror::Error)]
#[error("cannot read {}: {source}", path.display())]
struct Unreadable {
    path: PathBuf,
    source: ImageError,
}

impl Hint for Unreadable {
    fn hint(&self) -> Option<Advice> {
        Some("give JPEG, PNG or TIFF images".into())
    }
}

#[derive(Debug, thiserror::Error)]
#[error("cannot draw predictions: the project has no image folder")]
struct NoImages;

impl Hint for NoImages {
    fn hint(&self) -> Option<Advice> {
        Some("put the images of the model into PROJECT/images".into())
    }
}
