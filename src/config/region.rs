//! `region`: the part of the scene that a plan is for, as on the command line and in
//! `viewrank.toml`.

use std::{fmt, path::PathBuf, str::FromStr};

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

use crate::io::region_file::parse_box;

/// Region of interest; written as `auto`, as six numbers, or as the path of a file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum RegionChoice {
    /// The box around the places with the most pixels per area.
    Auto,
    /// Two opposite corners of a box along the axes of the model, scene units: `x0,y0,z0,x1,y1,z1`.
    Box([f64; 6]),
    /// GeoJSON polygons, a closed PLY mesh, or six numbers.
    File(PathBuf),
}

const AUTO: &str = "auto";

/// A box with a wrong number of coordinates, or an empty text.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is not auto, a box x0,y0,z0,x1,y1,z1 or a file")]
pub struct RegionChoiceError(String);

impl RegionChoice {
    /// Returns whether the text names a file.
    pub fn is_file(text: &str) -> bool {
        matches!(text.parse(), Ok(Self::File(_)))
    }

    /// The file that has the region.
    pub fn file(&self) -> Option<PathBuf> {
        match self {
            Self::File(path) => Some(path.clone()),
            Self::Auto | Self::Box(_) => None,
        }
    }
}

impl FromStr for RegionChoice {
    type Err = RegionChoiceError;

    fn from_str(text: &str) -> Result<Self, RegionChoiceError> {
        let text = text.trim();
        let is_list = text.contains(',')
            && text
                .split(',')
                .all(|word| word.trim().parse::<f64>().is_ok());
        match parse_box(text) {
            Some(corners) => Ok(Self::Box(corners)),
            // Numbers alone are a mistyped box, although a file could have that name.
            None if text.is_empty() || is_list => Err(RegionChoiceError(text.into())),
            None if text == AUTO => Ok(Self::Auto),
            None => Ok(Self::File(text.into())),
        }
    }
}

impl fmt::Display for RegionChoice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Auto => f.write_str(AUTO),
            Self::Box(corners) => f.write_str(&corners.map(|x| x.to_string()).join(",")),
            Self::File(path) => write!(f, "{}", path.display()),
        }
    }
}

impl TryFrom<String> for RegionChoice {
    type Error = RegionChoiceError;

    fn try_from(text: String) -> Result<Self, RegionChoiceError> {
        text.parse()
    }
}

impl From<RegionChoice> for String {
    fn from(choice: RegionChoice) -> String {
        choice.to_string()
    }
}

impl JsonSchema for RegionChoice {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "RegionChoice".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_region_is_auto_a_box_or_a_file() {
        assert_eq!("auto".parse(), Ok(RegionChoice::Auto));
        assert_eq!(
            "-1, 0,0,1.5,2,3e1".parse(),
            Ok(RegionChoice::Box([-1.0, 0.0, 0.0, 1.5, 2.0, 30.0]))
        );
        assert_eq!(
            "sites/1,2.geojson".parse(),
            Ok(RegionChoice::File("sites/1,2.geojson".into()))
        );
        for text in [
            "",
            "1,2,3",
            "1,2,3,4,5,nan",
            "0,0,0,1,1,inf",
            "1,2,3,4,5,6,7",
        ] {
            assert!(text.parse::<RegionChoice>().is_err(), "{text}");
        }
    }

    #[test]
    fn a_region_survives_a_round_trip() {
        for text in ["auto", "-1.5,0,0,1,2,3", "a/b.ply"] {
            assert_eq!(text.parse::<RegionChoice>().unwrap().to_string(), text);
        }
    }
}
