//! `viewrank predict`: what the confidence sees in pictures, to look at.

use std::path::{Path, PathBuf};

use crate::config::CONFIDENCE_WORDS;
use crate::{
    base::error::Hint,
    io::output::{Contents, Disk, FileSet},
    method::confidence::{self, Image, Predictor, Proxy, Trained, size_for_confidence},
    show::{pictures::confidence_picture, tables},
};
use clap::Args;
use rayon::prelude::*;

use super::{Failure, print};

/// Draw where a backend is expected to succeed, from single images.
///
/// DIR gets NAME.png, the image beside its confidence in colours with a legend, and NAME.npy, the confidence as float32 (rows x columns of a grid
/// that covers the image).
#[derive(Args)]
pub struct Arguments {
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,

    /// Folder for the pictures
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Source of confidence: proxy, shipped or a model file [default: shipped if there is one, else proxy]
    #[arg(long, value_name = "SOURCE|FILE")]
    confidence: Option<String>,
    /// Don't list the written files
    #[arg(long, short)]
    quiet: bool,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let predictor = predictor(arguments.confidence.as_deref())?;
    let of_image = |path: &PathBuf| {
        let image =
            Image::read(path, size_for_confidence).map_err(|source| Unreadable { path: path.clone(), source })?;
        let map = predictor.predict(&image).map;
        let shape = [map.rows as usize, map.columns as usize];
        let raw = tables::array(&shape, map.values().collect::<Vec<f32>>());
        Ok::<_, Failure>((name(path), confidence_picture(&image, &map), raw))
    };
    let made: Vec<_> = arguments.images.par_iter().map(of_image).collect::<Result<_, _>>()?;
    let mut files = FileSet::new(&arguments.out, "predict");
    for (name, picture, raw) in made {
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
    print(&files.files.keys().map(|name| format!("{}\n", arguments.out.join(name).display())).collect::<String>())
}

fn predictor(source: Option<&str>) -> Result<Box<dyn Predictor>, Failure> {
    let trained = match source {
        Some("proxy") => None,
        None | Some("shipped") => Trained::shipped(),
        Some(word) if CONFIDENCE_WORDS.contains(&word) => return Err(NoPredictor(word.into()).into()),
        Some(file) => Some(Trained::read(Path::new(file))?),
    };
    match trained {
        None => Ok(Box::new(Proxy)),
        Some(Trained { picture: Some(picture), .. }) => Ok(Box::new(picture)),
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
#[error("{0} says nothing of a single picture")]
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
        Some("train where the images are there, or take --confidence proxy".into())
    }

    fn is_usage(&self) -> bool {
        true
    }
}
