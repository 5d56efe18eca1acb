//! The settings as a list of keys, read from the definition: what `viewrank config` prints and what
//! values are checked against.

use std::sync::LazyLock;

use schemars::generate::SchemaSettings;
use serde_json::{Map, Value};

use super::{ConfigError, Configuration, Settings};
use crate::model::scene::Units;

/// A key of `viewrank.toml`.
#[derive(Clone, Debug, PartialEq)]
pub struct Key {
    /// Full name with sections: `target.gsd`.
    pub name: String,
    pub doc: String,
    unit: Option<String>,
    /// Default; `Null`: chosen from the data or by the backend.
    pub default: Value,
    /// Accepted words of an enumerated key.
    pub words: Vec<String>,
    /// Runs commands, so that a project's file, which may come from anybody, must not set it.
    pub user_only: bool,
    above: Option<f64>,
    min: Option<f64>,
    max: Option<f64>,
}

/// Lists all keys, in the order of the definition.
pub fn keys() -> &'static [Key] {
    static KEYS: LazyLock<Vec<Key>> = LazyLock::new(|| {
        let mut keys = Vec::new();
        collect(&definition(), &default(), "", &mut keys);
        keys
    });
    &KEYS
}

impl Settings {
    /// Checks ranges, and values against each other, of settings that another file than
    /// `viewrank.toml` holds.
    ///
    /// # Errors
    /// The first key with its value and why it is refused.
    pub fn check(&self) -> Result<(), String> {
        // Reading has checked the types, but ranges are in the schema alone.
        let all = serde_json::to_value(self).expect("settings are JSON");
        for key in keys() {
            let value = key
                .name
                .split('.')
                .try_fold(&all, |value, part| value.get(part))
                .unwrap_or(&Value::Null);
            let numbers = value
                .as_array()
                .map_or(std::slice::from_ref(value), Vec::as_slice);
            if numbers
                .iter()
                .filter_map(Value::as_f64)
                .any(|number| !key.allows(number))
            {
                return Err(format!(
                    "{} = {value}: must be {}",
                    key.name,
                    key.range().unwrap_or_default()
                ));
            }
        }
        let together = Configuration {
            settings: self.clone(),
            places: Default::default(),
        }
        .check_together();
        together.map_err(|error| match error {
            ConfigError::Value {
                key, value, why, ..
            } => format!("{key} = {value}: {why}"),
            error => error.to_string(),
        })
    }
}

impl Key {
    /// Unit of the value. Lengths are metres only where the model is known to be metric.
    pub fn unit(&self, units: Option<Units>) -> Option<String> {
        let length = if units == Some(Units::Metric) {
            "m"
        } else {
            "scene units"
        };
        self.unit
            .as_ref()
            .map(|unit| unit.replace("length", length))
    }

    /// True for lengths, also those per pixel.
    pub(super) fn is_length(&self) -> bool {
        self.unit
            .as_deref()
            .is_some_and(|unit| unit == "length" || unit == "length/px")
    }

    /// Describes the accepted range in words; `None`: any value.
    pub fn range(&self) -> Option<String> {
        match (self.above, self.min, self.max) {
            (Some(above), _, Some(max)) => Some(format!("above {above}, at most {max}")),
            (Some(above), _, None) => Some(format!("above {above}")),
            (None, Some(min), Some(max)) => Some(format!("{min} to {max}")),
            (None, Some(min), None) => Some(format!("at least {min}")),
            (None, None, Some(max)) => Some(format!("at most {max}")),
            (None, None, None) if !self.words.is_empty() => Some(self.words.join(", ")),
            (None, None, None) => None,
        }
    }

    pub(super) fn allows(&self, number: f64) -> bool {
        // TOML has inf and nan.
        number.is_finite()
            && self.above.is_none_or(|above| number > above)
            && self.min.is_none_or(|min| number >= min)
            && self.max.is_none_or(|max| number <= max)
    }
}

fn definition() -> Value {
    // Inlined: behind a reference, `collect` would find no properties of a section.
    let settings = SchemaSettings::draft2020_12().with(|s| s.inline_subschemas = true);
    settings
        .into_generator()
        .into_root_schema_for::<Settings>()
        .to_value()
}

fn default() -> Value {
    serde_json::to_value(Settings::default()).expect("settings are JSON")
}

/// Appends the keys of a section, prefixed with `path`.
fn collect(section: &Value, defaults: &Value, path: &str, keys: &mut Vec<Key>) {
    for (name, schema) in section["properties"].as_object().into_iter().flatten() {
        let name = if path.is_empty() {
            name.clone()
        } else {
            format!("{path}.{name}")
        };
        let default = &defaults[name.rsplit('.').next().unwrap_or(&name)];
        match schema.as_object() {
            Some(object) if !object.contains_key("properties") => {
                keys.push(key(name, object, default))
            }
            _ => collect(schema, default, &name, keys),
        }
    }
}

fn key(name: String, schema: &Map<String, Value>, default: &Value) -> Key {
    let text = |attribute: &str| {
        schema
            .get(attribute)
            .and_then(Value::as_str)
            .map(String::from)
    };
    let number = |attribute: &str| schema.get(attribute).and_then(Value::as_f64);
    Key {
        name,
        doc: text("description").unwrap_or_default().replace('\n', " "),
        unit: text("unit"),
        default: default.clone(),
        words: constants(schema),
        user_only: schema
            .get("userOnly")
            .and_then(Value::as_bool)
            .unwrap_or(false),
        above: number("exclusiveMinimum"),
        min: number("minimum"),
        max: number("maximum"),
    }
}

/// Collects the constants of an enum from each form in which schemars writes them.
fn constants(schema: &Map<String, Value>) -> Vec<String> {
    let mut found: Vec<String> = schema
        .get("const")
        .and_then(Value::as_str)
        .map(String::from)
        .into_iter()
        .collect();
    found.extend(
        schema
            .get("enum")
            .and_then(Value::as_array)
            .into_iter()
            .flatten()
            .filter_map(Value::as_str)
            .map(String::from),
    );
    for alternatives in ["oneOf", "anyOf"] {
        let members = schema
            .get(alternatives)
            .and_then(Value::as_array)
            .into_iter()
            .flatten();
        found.extend(
            members
                .filter_map(Value::as_object)
                .flat_map(self::constants),
        );
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn find(name: &str) -> &'static Key {
        keys().iter().find(|key| key.name == name).unwrap()
    }

    #[test]
    fn every_number_of_the_method_has_its_key_and_default() {
        let table = [
            ("coverage.min_cameras", 3.0),
            ("fulfilment.alpha", 0.5),
            ("fulfilment.sigma_px", 0.5),
            ("surface.edge_factor", 20.0),
            ("surface.max_edge_factor", 100.0),
            ("partners.candidates", 22.0),
            ("partners.draws", 100.0),
            ("partners.triangle_fraction", 10.0),
            ("partners.k", 5.0),
            ("seed", 0.0),
        ];
        for (name, default) in table {
            assert_eq!(find(name).default.as_f64(), Some(default), "{name}");
        }
        let by_data = [
            "target.gsd",
            "target.accuracy",
            "confidence.p0",
            "confidence.cosine_power",
        ];
        let by_backend = [
            "confidence.scale_octaves",
            "confidence.full_angle",
            "confidence.agree",
            "ranking.support",
            "image_scale",
        ];
        for name in by_data.iter().chain(&by_backend) {
            assert!(find(name).default.is_null(), "{name}");
        }
        assert_eq!(find("partners.method").default, "search");
        assert_eq!(find("confidence.source").default, "auto");
    }

    #[test]
    fn every_key_says_what_it_is_and_every_number_has_a_range() {
        for key in keys() {
            assert!(!key.doc.is_empty(), "{}", key.name);
            assert!(
                !key.default.is_number() || key.range().is_some() || key.name == "seed",
                "{}",
                key.name
            );
        }
    }

    #[test]
    fn lengths_are_metres_only_in_metric_models() {
        assert_eq!(
            find("target.gsd").unit(Some(Units::Metric)).unwrap(),
            "m/px"
        );
        assert_eq!(
            find("target.gsd").unit(Some(Units::Relative)).unwrap(),
            "scene units/px"
        );
        assert_eq!(find("target.accuracy").unit(None).unwrap(), "scene units");
    }

    #[test]
    fn words_and_ranges() {
        assert_eq!(find("surface.kind").words, ["auto", "3d", "terrain"]);
        assert_eq!(find("fulfilment.alpha").range().unwrap(), "0 to 1");
        assert_eq!(find("target.gsd").range().unwrap(), "above 0");
        assert!(
            find("target.gsd").allows(0.1)
                && !find("target.gsd").allows(0.0)
                && !find("target.gsd").allows(f64::NAN)
        );
    }
}
