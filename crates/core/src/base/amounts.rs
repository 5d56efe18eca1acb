//! Values that people write with a unit: "5%", "2h", "50M".

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

/// Length of a plan: a number of view clusters, or a share of the registered views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "RawAmount", into = "String")]
pub enum Budget {
    Clusters(u64),
    Views(Share),
}

impl Budget {
    /// Number of clusters allowed for a number of registered `views`; a fraction is rounded up.
    pub fn clusters(self, views: usize) -> usize {
        match self {
            Self::Clusters(n) => usize::try_from(n).unwrap_or(usize::MAX),
            // 0.07 has no exact binary form: 7 % of 100 comes out slightly above 7 and would round
            // up to 8.
            Self::Views(share) => (share.0 * views as f64 - 1e-9).ceil().max(0.0) as usize,
        }
    }
}

/// A share, 0 to 1; written in per cent, and read as `80%`, `80` or `0.8`.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "RawAmount", into = "String")]
pub struct Share(pub f64);

/// A length of time in seconds; written in days, hours, minutes, seconds and milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "RawAmount", into = "String")]
pub struct TimeSpan(pub f64);

/// A number of things; suffixes k, M, G for 10^3, 10^6, 10^9.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "RawAmount", into = "String")]
pub struct Count(pub f64);

/// A memory size in bytes; suffixes K, M, G, T for 1024, 1024^2, 1024^3, 1024^4.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "RawAmount", into = "String")]
pub struct Bytes(pub u64);

#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("\"{text}\" is not {wanted}")]
pub struct AmountError {
    text: String,
    wanted: &'static str,
}

/// The text form of an amount.
pub trait Amount: FromStr<Err = AmountError> + fmt::Display {
    /// The accepted form with an example, for errors.
    const WANTED: &'static str;
    /// Regular expression for the JSON schema.
    const PATTERN: &'static str;

    fn refuse(text: &str) -> AmountError {
        AmountError {
            text: text.into(),
            wanted: Self::WANTED,
        }
    }
}

impl Amount for Budget {
    const WANTED: &'static str =
        "a whole number from 1 such as 40, or a share of the views such as 5% or 0.05";
    const PATTERN: &'static str = r"^[0-9]*[1-9][0-9]*$|^[0-9.]+ ?%$";
}

impl Amount for Share {
    const WANTED: &'static str = "a share above 0% and up to 100% such as 80% or 0.8";
    const PATTERN: &'static str = "^[0-9.]+ ?%$";
}

impl Amount for TimeSpan {
    const WANTED: &'static str = "a time such as 2h, 90min, 45s, 500ms or 1d6h";
    const PATTERN: &'static str = "^([0-9.]+ ?(d|h|min|m|s|ms) ?)+$";
}

impl Amount for Count {
    const WANTED: &'static str = "a number such as 800k, 50M or 1.5G";
    const PATTERN: &'static str = "^[0-9.]+ ?[kMG]?$";
}

impl Amount for Bytes {
    const WANTED: &'static str = "a size such as 800M or 4G";
    const PATTERN: &'static str = "^[0-9.]+ ?[KMGT]?(i?B)?$";
}

impl FromStr for Budget {
    type Err = AmountError;

    fn from_str(text: &str) -> Result<Self, AmountError> {
        let share = || {
            text.parse()
                .map(Self::Views)
                .map_err(|_| Self::refuse(text))
        };
        // Without a sign only below 1: 1.5 may be meant as clusters or as per cent.
        let text_is_share = text.trim().ends_with('%') || text.trim().starts_with(['0', '.']);
        match text.trim().parse() {
            Ok(0) => Err(Self::refuse(text)),
            Ok(clusters) => Ok(Self::Clusters(clusters)),
            Err(_) if text_is_share => share(),
            Err(_) => Err(Self::refuse(text)),
        }
    }
}

impl FromStr for Share {
    type Err = AmountError;

    fn from_str(text: &str) -> Result<Self, AmountError> {
        let (number, in_percent) = match text.trim().strip_suffix('%') {
            Some(number) => (non_negative(number.trim()), true),
            None => (non_negative(text.trim()), false),
        };
        if !in_percent && number == Some(1.0) {
            return Err(AmountError {
                text: text.into(),
                wanted: "a clear share: write 1% or 100%",
            });
        }
        let share = number.map(|n| if in_percent || n > 1.0 { n / 100.0 } else { n });
        share
            .filter(|share| *share > 0.0 && *share <= 1.0)
            .map(Self)
            .ok_or_else(|| Self::refuse(text))
    }
}

impl FromStr for TimeSpan {
    type Err = AmountError;

    fn from_str(text: &str) -> Result<Self, AmountError> {
        let mut rest = text.trim();
        let mut seconds = 0.0;
        while !rest.is_empty() {
            let (number, after) = split(rest, |c| c.is_ascii_digit() || c == '.');
            let (unit, after) = split(after.trim_start(), char::is_alphabetic);
            let second = seconds_of(unit).ok_or_else(|| Self::refuse(text))?;
            seconds += second * non_negative(number).ok_or_else(|| Self::refuse(text))?;
            rest = after.trim_start();
        }
        if text.trim().is_empty() {
            Err(Self::refuse(text))
        } else {
            Ok(Self(seconds))
        }
    }
}

impl FromStr for Count {
    type Err = AmountError;

    fn from_str(text: &str) -> Result<Self, AmountError> {
        let (number, unit) = split(text.trim(), |c| c.is_ascii_digit() || c == '.');
        let factor = match unit.trim() {
            "" => 1.0,
            "k" => 1e3,
            "M" => 1e6,
            "G" => 1e9,
            _ => return Err(Self::refuse(text)),
        };
        non_negative(number)
            .map(|n| Self(n * factor))
            .ok_or_else(|| Self::refuse(text))
    }
}

/// Units of [`Bytes`], smallest first, each 1024 times the one before.
const BYTE_UNITS: [&str; 5] = ["", "K", "M", "G", "T"];

impl FromStr for Bytes {
    type Err = AmountError;

    fn from_str(text: &str) -> Result<Self, AmountError> {
        let (number, unit) = split(text.trim(), |c| c.is_ascii_digit() || c == '.');
        let unit = unit
            .trim()
            .trim_end_matches('B')
            .trim_end_matches('i')
            .to_uppercase();
        let power = BYTE_UNITS
            .iter()
            .position(|&known| known == unit)
            .ok_or_else(|| Self::refuse(text))?;
        let number = non_negative(number).ok_or_else(|| Self::refuse(text))?;
        Ok(Self((number * 1024f64.powi(power as i32)).round() as u64))
    }
}

fn seconds_of(unit: &str) -> Option<f64> {
    Some(match unit {
        "d" => 86_400.0,
        "h" => 3_600.0,
        "min" | "m" => 60.0,
        "s" => 1.0,
        "ms" => 0.001,
        _ => return None,
    })
}

fn non_negative(number: &str) -> Option<f64> {
    let digits = number.bytes().all(|b| b.is_ascii_digit() || b == b'.');
    number
        .parse()
        .ok()
        .filter(|n: &f64| digits && n.is_finite())
}

/// Splits `text` after its longest prefix of characters that `belongs` accepts.
fn split(text: &str, belongs: impl Fn(char) -> bool) -> (&str, &str) {
    text.split_at(text.find(|c| !belongs(c)).unwrap_or(text.len()))
}

impl fmt::Display for Budget {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Clusters(n) => write!(f, "{n}"),
            Self::Views(share) => share.fmt(f),
        }
    }
}

impl fmt::Display for Share {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        // Rounded to nine places: 0.07 would print as 7.000000000000001 %.
        write!(f, "{}%", (self.0 * 1e11).round() / 1e9)
    }
}

impl fmt::Display for TimeSpan {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let mut rest = self.0;
        for unit in ["d", "h", "min"] {
            let length = seconds_of(unit).unwrap_or(1.0);
            let whole = (rest / length).floor();
            if whole > 0.0 {
                write!(f, "{whole}{unit}")?;
                rest -= whole * length;
            }
        }
        if rest > 0.0 || self.0 == 0.0 {
            write!(f, "{rest}s")
        } else {
            Ok(())
        }
    }
}

impl fmt::Display for Count {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.0 {
            n if n >= 1e9 => write!(f, "{}G", n / 1e9),
            n if n >= 1e6 => write!(f, "{}M", n / 1e6),
            n if n >= 1e3 => write!(f, "{}k", n / 1e3),
            n => write!(f, "{n}"),
        }
    }
}

impl fmt::Display for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let whole = |power: &usize| self.0 != 0 && self.0.trailing_zeros() as usize >= 10 * power;
        let power = (0..BYTE_UNITS.len()).rev().find(whole).unwrap_or(0);
        write!(f, "{}{}", self.0 >> (10 * power), BYTE_UNITS[power])
    }
}

/// An amount in TOML: a string ("40") or a number (40, 0.8).
#[derive(Deserialize)]
#[serde(untagged)]
enum RawAmount {
    Text(String),
    Whole(u64),
    Fraction(f64),
}

impl RawAmount {
    fn text(self) -> String {
        match self {
            Self::Text(text) => text,
            Self::Whole(number) => number.to_string(),
            Self::Fraction(number) => number.to_string(),
        }
    }
}

macro_rules! written_as_text {
    ($($amount:ident),*) => {$(
        impl TryFrom<RawAmount> for $amount {
            type Error = AmountError;

            fn try_from(written: RawAmount) -> Result<Self, AmountError> {
                written.text().parse()
            }
        }

        impl From<$amount> for String {
            fn from(amount: $amount) -> String {
                amount.to_string()
            }
        }

        #[cfg(feature = "schema")]
        impl schemars::JsonSchema for $amount {
            fn schema_name() -> std::borrow::Cow<'static, str> {
                stringify!($amount).into()
            }

            fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
                schemars::json_schema!({ "type": "string", "pattern": Self::PATTERN })
            }
        }
    )*};
}

written_as_text!(Budget, Share, TimeSpan, Count, Bytes);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amounts_are_read_as_people_write_them() {
        assert_eq!("40".parse(), Ok(Budget::Clusters(40)));
        assert_eq!("5%".parse(), Ok(Budget::Views(Share(0.05))));
        assert_eq!("0.05".parse(), Ok(Budget::Views(Share(0.05))));
        assert_eq!("12.5 %".parse(), Ok(Share(0.125)));
        assert!(
            ["80%", "80", "0.8", ".8"]
                .iter()
                .all(|text| text.parse() == Ok(Share(0.8)))
        );
        assert_eq!(
            "0.5%".parse(),
            Ok(Share(0.005)),
            "with the sign it is per cent"
        );
        assert_eq!("2h".parse(), Ok(TimeSpan(7200.0)));
        assert_eq!("1d 6h".parse(), Ok(TimeSpan(108_000.0)));
        assert_eq!("1.5min".parse(), Ok(TimeSpan(90.0)));
        assert_eq!("1s 500ms".parse(), Ok(TimeSpan(1.5)));
        assert_eq!("50M".parse(), Ok(Count(50e6)));
        assert_eq!("800 k".parse(), Ok(Count(8e5)));
        assert_eq!("1.5G".parse(), Ok(Bytes(3 << 29)));
        assert_eq!("800MiB".parse(), Ok(Bytes(800 << 20)));
    }

    #[test]
    fn malformed_amounts_are_refused() {
        assert!(
            ["", "-3", "4.5", "x", "101%"]
                .iter()
                .all(|text| text.parse::<Budget>().is_err())
        );
        assert!(
            ["", "1", "180", "1e1%", "-1%", "nan%", "80 %%"]
                .iter()
                .all(|text| text.parse::<Share>().is_err())
        );
        assert!(
            ["", "2", "h", "2 weeks", "inf h", "1h30"]
                .iter()
                .all(|text| text.parse::<TimeSpan>().is_err())
        );
        assert!(
            ["", "M", "5m", "1e9"]
                .iter()
                .all(|text| text.parse::<Count>().is_err())
        );
        assert!(
            ["", "G", "5X", "-1G", "5GG"]
                .iter()
                .all(|text| text.parse::<Bytes>().is_err())
        );
    }

    #[test]
    fn amounts_survive_a_round_trip() {
        for text in ["40", "7%", "0.5%"] {
            assert_eq!(text.parse::<Budget>().unwrap().to_string(), text);
        }
        for text in ["1d6h", "1min30s", "0s", "2h", "0.5s"] {
            assert_eq!(text.parse::<TimeSpan>().unwrap().to_string(), text);
        }
        for text in ["50M", "1.5G", "20k", "999"] {
            assert_eq!(text.parse::<Count>().unwrap().to_string(), text);
        }
        for text in ["4G", "800M", "1536M", "1T", "1000", "0"] {
            assert_eq!(text.parse::<Bytes>().unwrap().to_string(), text);
        }
    }
}
