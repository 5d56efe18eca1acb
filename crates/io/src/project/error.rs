//! Errors of opening a project.

use std::{
    io,
    path::{Path, PathBuf},
};

use viewrank_core::base::error::{Advice, Hint};

use super::ImageFolder;
use crate::{
    formats::{Fault, Problem},
    mistaken::{self, Mistaken},
    paths::is_outside,
    shell::command_path,
};

/// What to do about a model of COLMAP with poses and no points.
pub(super) const TO_GIVE_POINTS: &str = "triangulate them (colmap point_triangulator), or copy a PLY cloud in the coordinates of the cameras into the folder of the model";

/// Returns the path between quotes that a shell has passed on.
fn unquoted(path: &Path) -> Option<&Path> {
    let text = path.to_str()?;
    let inner = |quote: char| text.strip_prefix(quote)?.strip_suffix(quote);
    ['"', '\''].into_iter().find_map(inner).map(Path::new)
}

/// Error of opening a project or reading its model.
#[derive(Debug, thiserror::Error)]
pub enum ProjectError {
    #[error("{0}: no such file or folder")]
    NotFound(PathBuf),
    #[error("no sparse model under {path}; looked for {looked_for}")]
    NoModel { path: PathBuf, looked_for: String },
    #[error("no sparse model in {path} itself, but in several folders below it")]
    SeveralProjects { path: PathBuf, below: Vec<PathBuf> },
    #[error("incomplete COLMAP model in {folder}: {missing} missing")]
    IncompleteModel { folder: PathBuf, missing: String },
    #[error("no sub-model {wanted:?} in {path}, only {present}")]
    NoSuchModel {
        path: PathBuf,
        wanted: String,
        present: String,
    },
    #[error("cannot read {path}: {source}")]
    Io { path: PathBuf, source: io::Error },
    #[error("{path}, {fault}")]
    Fault { path: PathBuf, fault: Fault },
    #[error("{path} is {}", mistaken.what)]
    Mistaken { path: PathBuf, mistaken: Mistaken },
    /// JSON in the place of nerfstudio's cameras.
    #[error("{path} is {what}")]
    WithoutFrames { path: PathBuf, what: &'static str },
    #[error("{path} is {}", mistaken.what)]
    NotFetched {
        path: PathBuf,
        mistaken: Mistaken,
        /// Name of the model that is there.
        used: String,
    },
    #[error("the model {0} has changed since it was read")]
    ModelChanged(PathBuf),
    #[error("the images {:?} and {:?} of the model {path} are one file", names[0], names[1])]
    OneFile { path: PathBuf, names: [String; 2] },
    #[error("no image list (list.txt) for {0} in its folder or the one above")]
    NoImageList(PathBuf),
}

impl ProjectError {
    /// The same error, or that the file at fault is of another kind. Quotes no file outside of
    /// `named`, the folder that the user named.
    pub(super) fn explained(self, named: &Path) -> Self {
        match self {
            Self::Fault { path, fault } => {
                let mistaken = mistaken::of_file(&path).or_else(|| mistaken::text_as_binary(&path));
                // The kind of a file says nothing of its contents, which a fault may quote.
                let without_frames = mistaken::json_without_frames(&path, &fault);
                match (mistaken, without_frames) {
                    (Some(mistaken), _) => Self::Mistaken { path, mistaken },
                    (None, Some(what)) => Self::WithoutFrames { path, what },
                    (None, None) if is_outside(&path, named) => Self::Fault {
                        path,
                        fault: Fault::new(fault.file, fault.place, Problem::Hidden),
                    },
                    (None, None) => Self::Fault { path, fault },
                }
            }
            error => error,
        }
    }
}

impl ProjectError {
    /// Makes the error of a file that cannot be read.
    pub fn io(path: &Path) -> impl Fn(io::Error) -> Self {
        move |source| Self::Io {
            path: path.into(),
            source,
        }
    }

    /// Makes the error of a file with a fault.
    pub fn fault(path: &Path) -> impl Fn(Fault) -> Self {
        move |fault| Self::Fault {
            path: path.into(),
            fault,
        }
    }
}

impl Hint for ProjectError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::NotFound(path) if unquoted(path).is_some_and(Path::exists) => {
                let name = unquoted(path).unwrap_or(path);
                format!("the quotes became part of the name; without them it is there: {}", command_path(name)).into()
            }
            Self::NotFound(_) => "name the project folder, which contains `sparse` and `images`".into(),
            Self::NoModel { path, .. } if path.is_file() => {
                "this file is no sparse model, and none is beside it: name the project folder, which contains `sparse`"
                    .into()
            }
            Self::NoModel { path, .. } if ImageFolder::new(path).first_image().is_some() => {
                "these are only photographs: run structure from motion first (such as colmap automatic_reconstructor), then name the folder that contains its model"
                    .into()
            }
            Self::NoModel { .. } => "name a folder that contains `sparse`, or the folder of the model itself".into(),
            Self::SeveralProjects { path, below } => {
                let named = below.iter().take(3).map(|folder| command_path(folder));
                let more = if below.len() > 3 { ", ..." } else { "" };
                let named: Vec<String> = named.collect();
                let one = Advice::text(format!("name one of them: {}{more}", named.join(", ")));
                match path.join("images") {
                    images if images.is_dir() => {
                        one.and("; where its images are here, with ").set_to("images", command_path(&images))
                    }
                    _ => one,
                }
            }
            Self::IncompleteModel { missing, .. } if missing.starts_with("points3D") => {
                TO_GIVE_POINTS.into()
            }
            Self::IncompleteModel { .. } => {
                "export the model again, with cameras, images and points3D in one format, binary or text".into()
            }
            Self::NoSuchModel { .. } => Advice::text("pass one of these names to ").set("model").and(", or omit it"),
            Self::Io { .. } => "check that the file exists and is readable".into(),
            Self::Fault { fault, .. } => fault.problem.hint(),
            Self::Mistaken { mistaken, .. } => mistaken.cure.into(),
            Self::WithoutFrames { .. } => Advice::text(
                "give it another name, and put the transforms.json with the cameras in its place (a region is given by ",
            )
            .set_to("region", "FILE")
            .and(")"),
            Self::NotFetched { mistaken, used, .. } => {
                Advice::text(format!("{}; to plan without it: ", mistaken.cure)).set_to("model", used)
            }
            Self::ModelChanged(_) => "once the model is complete, read it and plan again; nothing was written".into(),
            Self::OneFile { names, .. } => format!(
                "take one of the two out of the model, as \"{}\", or give each a file of its own", names[1]
            )
            .into(),
            Self::NoImageList(_) => "copy Bundler's image list there: one line per camera with the image name".into(),
        })
    }

    fn is_usage(&self) -> bool {
        matches!(self, Self::NoSuchModel { .. })
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::NotFound(path) | Self::ModelChanged(path) | Self::NoImageList(path) => Some(path),
            Self::NoModel { path, .. }
            | Self::SeveralProjects { path, .. }
            | Self::IncompleteModel { folder: path, .. }
            | Self::NoSuchModel { path, .. }
            | Self::Io { path, .. }
            | Self::Mistaken { path, .. }
            | Self::WithoutFrames { path, .. }
            | Self::NotFetched { path, .. }
            | Self::OneFile { path, .. }
            | Self::Fault { path, .. } => Some(path),
        }
    }
}
