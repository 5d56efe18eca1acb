//! `viewrank undistort`: undistorted images and their model, as a COLMAP dense workspace.

use std::path::{Path, PathBuf};

use crate::{
    apps::undistort::{self, UndistortOptions, UndistortReport},
    base::shell::command_path,
    config::CommandLineSettings,
    io::project::Project,
};
use clap::Args;

use super::{Failure, Format, config, print, print_json, progress::ProgressDisplay, warn};

/// Make the undistorted images that most MVS programs need, as a COLMAP dense workspace.
///
/// Cameras become PINHOLE, and pixels are those of COLMAP's image_undistorter with the same
/// options. An interrupted run resumes where it stopped. Then plan and export the workspace:
/// viewrank plan PROJECT/dense.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the project, or its model
    #[arg(value_parser = super::arguments::project())]
    project: PathBuf,
    /// Sub-model, such as 1 for sparse/1 [default: the one with most registered images]
    #[arg(long, value_name = "N")]
    model: Option<String>,
    /// Folder to which the image names of the model are relative [default: where they are found]
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// Folder of the workspace [default: PROJECT/dense, or PROJECT/undistorted beside the dense
    /// workspace of another program]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    /// 0: no blank pixels, 1: no pixel of the image is lost
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share, help_heading = "As in COLMAP")]
    blank_pixels: f64,
    /// Smallest size relative to the distorted image
    #[arg(long, value_name = "FACTOR", default_value_t = 0.2, value_parser = factor, help_heading = "As in COLMAP")]
    min_scale: f64,
    /// Largest size relative to the distorted image
    #[arg(long, value_name = "FACTOR", default_value_t = 2.0, value_parser = factor, help_heading = "As in COLMAP")]
    max_scale: f64,
    /// Longest side of the undistorted images
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(1..), help_heading = "As in COLMAP")]
    max_image_size: Option<u32>,
    /// Region of interest: left,top,right,bottom as shares of the sides
    #[arg(long, value_name = "L,T,R,B", value_parser = region, help_heading = "As in COLMAP")]
    roi: Option<Roi>,

    /// Format of the results on stdout
    #[arg(long, value_enum, default_value_t, help_heading = "Output")]
    format: Format,
    /// Print errors only
    #[arg(short, long, help_heading = "Output")]
    quiet: bool,
}

/// Left, top, right, bottom.
#[derive(Clone, Copy)]
struct Roi([f64; 4]);

/// Undistorts the images to `out`, shows the progress unless `quiet`, and warns.
pub fn undistorted(
    project: &Project,
    options: &UndistortOptions,
    out: &Path,
    quiet: bool,
) -> Result<UndistortReport, Failure> {
    let progress = ProgressDisplay::new(quiet);
    let done = undistort::undistort(project, options, out, &project.disk(), &progress)?;
    progress.finish();
    done.warning().iter().for_each(|warning| warn(warning));
    Ok(done)
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    if arguments.min_scale > arguments.max_scale {
        let message = format!(
            "--min-scale {} is above --max-scale {}",
            arguments.min_scale, arguments.max_scale
        );
        return Err(Failure::new(
            super::Exit::Usage,
            message,
            "leave one of them out".to_owned(),
        ));
    }
    let project = Project::open_or_planned(&arguments.project, arguments.model.as_deref())?;
    let images = config::load(Some(&project), CommandLineSettings::default())?
        .settings
        .images;
    let project = project.with_images(arguments.images.as_deref().or(images.as_deref()));
    let out = arguments
        .out
        .clone()
        .unwrap_or_else(|| project.place_of_undistorted());
    let done = undistorted(&project, &arguments.options(), &out, arguments.quiet)?;
    match arguments.format {
        Format::Json => print_json(&done),
        Format::Text if arguments.quiet => Ok(()),
        Format::Text => print(text(&done)),
    }
}

impl Arguments {
    fn options(&self) -> UndistortOptions {
        let Self {
            blank_pixels,
            min_scale,
            max_scale,
            max_image_size,
            ..
        } = *self;
        let roi = self
            .roi
            .map_or(UndistortOptions::default().roi, |region| region.0);
        UndistortOptions {
            blank_pixels,
            min_scale,
            max_scale,
            max_image_size,
            roi,
        }
    }
}

fn text(done: &UndistortReport) -> Vec<String> {
    let folder = done.folder.display();
    let mut lines = vec![format!(
        "{} images in {folder}, {} of them computed now.",
        done.images, done.computed
    )];
    lines.extend(
        done.kept
            .iter()
            .map(|kept| format!("kept {kept}: not written by viewrank")),
    );
    let plan = format!("viewrank plan {}", command_path(&done.folder));
    lines.extend(
        done.is_without_points
            .then(|| "The model has no points.".into()),
    );
    lines.push(if done.is_without_points {
        let model = command_path(&done.folder.join("sparse"));
        format!(
            "Next: copy them as a PLY cloud, in the coordinates of the cameras, into {model}, then {plan}"
        )
    } else {
        format!("Next: {plan}")
    });
    lines
}

fn share(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "a number from 0 to 1")?;
    if (0.0..=1.0).contains(&value) {
        Ok(value)
    } else {
        Err("a number from 0 to 1".into())
    }
}

fn factor(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "a number above 0")?;
    if value > 0.0 && value.is_finite() {
        Ok(value)
    } else {
        Err("a number above 0".into())
    }
}

fn region(text: &str) -> Result<Roi, String> {
    let wrong = || {
        "four numbers from 0 to 1 with commas between, left before right and top before bottom"
            .to_owned()
    };
    let values: Vec<f64> = text
        .split(',')
        .map(share)
        .collect::<Result<_, _>>()
        .map_err(|_| wrong())?;
    let roi: [f64; 4] = values.try_into().map_err(|_| wrong())?;
    if roi[0] < roi[2] && roi[1] < roi[3] {
        Ok(Roi(roi))
    } else {
        Err(wrong())
    }
}
