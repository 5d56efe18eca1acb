//! `viewrank inspect`: contents of a sparse model.

use std::{collections::BTreeMap, path::PathBuf};

use crate::{
    base::advice::on_command_line,
    io::project::{ModelFormat, ModelLocation, Project, ProjectKind},
    model::scene::{Scene, Units, WarningKind},
    plan,
};
use clap::Args;
use serde::Serialize;

use super::{Failure, Format, config, print, print_json, terminal::is_stdout_terminal, wrapped};

/// Number of names listed in the text; further ones are only counted.
const LISTED: usize = 5;

/// Print the contents of a sparse model: views, cameras, points, observations, errors, units,
/// sub-models.
#[derive(Args)]
pub struct Arguments {
    /// Project folder, model folder or model file.
    #[arg(value_parser = super::arguments::project())]
    model: PathBuf,
    /// Sub-model, such as 1 for sparse/1 [default: the one with most registered images].
    #[arg(long = "model", value_name = "N")]
    sub_model: Option<String>,
    /// Format of the results on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// JSON output: numbers of the model.
#[derive(Serialize)]
struct Inspection {
    format: ModelFormat,
    path: PathBuf,
    kind: ProjectKind,
    image_folder: Option<PathBuf>,
    registered: usize,
    /// Images in the image folder without a pose in the model.
    unregistered: Vec<String>,
    cameras: usize,
    /// Number of cameras of each model.
    camera_models: BTreeMap<&'static str, usize>,
    points: usize,
    observations: usize,
    mean_track_length: Option<f64>,
    mean_reprojection_error_px: Option<f64>,
    /// Scene units per pixel.
    median_gsd: Option<f64>,
    /// `metric`, `relative`, or null if unknown.
    units: Option<Units>,
    /// Metres in a scene unit; null if unknown.
    metres_per_unit: Option<f64>,
    sub_models: Vec<SubModel>,
    warnings: Vec<String>,
}

#[derive(Serialize)]
struct SubModel {
    name: String,
    path: PathBuf,
    registered: u64,
    used: bool,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let project = Project::open_or_planned(&arguments.model, arguments.sub_model.as_deref())?;
    let settings = config::load(Some(&project), Default::default())?.settings;
    let project = project.with_images(settings.images.as_deref());
    let scene = project.read_scene()?;
    let place = plan::georeference(&project, &scene, &settings.frame);
    let metres = plan::metres(settings.units, &place);
    let inspection = Inspection {
        units: settings
            .units
            .or((metres == Some(1.0)).then_some(Units::Metric)),
        metres_per_unit: metres,
        ..inspect(&project, &scene)
    };
    match arguments.format {
        Format::Text => print(inspection.text()),
        Format::Json => print_json(&inspection),
    }
}

fn inspect(project: &Project, scene: &Scene) -> Inspection {
    let mut camera_models = BTreeMap::new();
    scene
        .cameras
        .iter()
        .for_each(|camera| *camera_models.entry(camera.model().name()).or_insert(0) += 1);
    let sub_model = |model: &ModelLocation, used| SubModel {
        name: model.name.clone(),
        path: model.path.clone(),
        registered: if used {
            scene.views.len() as u64
        } else {
            model.registered
        },
        used,
    };
    let others = project
        .other_models
        .iter()
        .map(|model| sub_model(model, false));
    let points = scene.points.len();
    let are_projected = scene
        .warnings
        .iter()
        .any(|warning| warning.kind == WarningKind::Projected);
    Inspection {
        format: project.model.format,
        path: project.model.path.clone(),
        kind: project.kind,
        image_folder: project.images.as_ref().map(|images| images.to_path_buf()),
        registered: scene.views.len(),
        unregistered: scene.unregistered.clone(),
        cameras: scene.cameras.len(),
        camera_models,
        points,
        observations: scene.observations(),
        mean_track_length: (points > 0).then(|| scene.observations() as f64 / points as f64),
        mean_reprojection_error_px: scene
            .mean_reprojection_error()
            .filter(|_| project.model.format.has_pixels() && !are_projected),
        median_gsd: scene.median_gsd(),
        units: None,
        metres_per_unit: None,
        sub_models: [sub_model(&project.model, true)]
            .into_iter()
            .chain(others)
            .collect(),
        warnings: scene
            .warnings
            .iter()
            .map(|warning| on_command_line(&warning.describe()))
            .collect(),
    }
}

impl Inspection {
    fn text(&self) -> Vec<String> {
        let line = |(name, value): &(&str, String)| {
            if is_stdout_terminal() {
                wrapped(&format!("{name:<25}"), value)
            } else {
                // One line for each, for `grep` and the like.
                vec![format!("{name:<25}{value}")]
            }
        };
        self.rows().iter().flat_map(line).collect()
    }

    /// Names and values.
    fn rows(&self) -> Vec<(&str, String)> {
        let of_model = |(model, n): (&&str, &usize)| format!("{n} {model}");
        let models: Vec<String> = self.camera_models.iter().map(of_model).collect();
        let images = self.image_folder.as_ref();
        let images = images.map_or("not found".into(), |folder| folder.display().to_string());
        let unregistered = list(&self.unregistered);
        let number =
            |value: Option<f64>, digits| value.map_or("-".into(), |v| format!("{v:.digits$}"));
        let unit = if self.metres_per_unit.is_some() {
            "m"
        } else {
            "units"
        };
        let gsd = self
            .median_gsd
            .map(|gsd| gsd * self.metres_per_unit.unwrap_or(1.0));
        let gsd = number(gsd, 6);
        let mut rows = vec![
            (
                "model",
                format!("{} ({})", self.path.display(), self.format.name()),
            ),
            ("images", images),
            (
                "views",
                format!("{} registered, {unregistered} not", self.registered),
            ),
            (
                "cameras",
                format!("{} ({})", self.cameras, models.join(", ")),
            ),
            ("points", self.points.to_string()),
            ("observations", self.observations.to_string()),
            ("mean track length", number(self.mean_track_length, 2)),
        ];
        // Projected observations have no reprojection error.
        let error = self.mean_reprojection_error_px;
        rows.extend(error.map(|px| ("mean reprojection error", format!("{px:.4} px"))));
        rows.extend([
            ("median GSD", format!("{gsd} {unit} per pixel")),
            ("units", self.units_in_words()),
        ]);
        let sub_models = self.sub_models.iter().filter(|_| self.sub_models.len() > 1);
        rows.extend(sub_models.map(|m| {
            let used = if m.used { ", used" } else { "" };
            let text = format!("{} ({} images){used}", m.name, m.registered);
            ("sub-model", text)
        }));
        let warnings = self.warnings.iter();
        rows.extend(warnings.map(|warning| ("warning", warning.clone())));
        rows
    }

    fn units_in_words(&self) -> String {
        match (self.units, self.metres_per_unit) {
            (Some(Units::Metric), _) => "metres".into(),
            (Some(Units::Relative), _) => "relative: lengths are in units of the model".into(),
            (None, Some(metres)) => {
                format!("of the model: {metres:.6} m each, by the GPS positions of the images")
            }
            (None, None) => {
                "unknown: lengths are in units of the model; if these are metres, set units = \"metric\"".into()
            }
        }
    }
}

/// Formats the number of names and the first of them.
fn list(names: &[String]) -> String {
    match names {
        [] => "0".into(),
        _ => {
            let more = if names.len() > LISTED { ", ..." } else { "" };
            format!(
                "{} ({}{more})",
                names.len(),
                names[..names.len().min(LISTED)].join(", ")
            )
        }
    }
}
