//! The WGS 84 ellipsoid: geodetic, earth-centred and UTM coordinates. Angles in degrees, lengths in
//! metres.

use nalgebra::{Matrix3, Vector3};

/// Semi-major axis, metres.
const A: f64 = 6_378_137.0;
/// Flattening.
const F: f64 = 1.0 / 298.257_223_563;
/// Square of the first eccentricity.
const E2: f64 = F * (2.0 - F);
/// Scale of UTM on the central meridian.
const K0: f64 = 0.9996;

/// Longitude and latitude in degrees, height above the ellipsoid in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geodetic {
    pub longitude: f64,
    pub latitude: f64,
    pub height: f64,
}

impl Geodetic {
    /// Converts to earth-centred, earth-fixed (ECEF) coordinates, metres.
    pub fn to_ecef(self) -> Vector3<f64> {
        let (sin_lat, cos_lat) = self.latitude.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.longitude.to_radians().sin_cos();
        let n = A / (1.0 - E2 * sin_lat * sin_lat).sqrt();
        let r = (n + self.height) * cos_lat;
        Vector3::new(
            r * cos_lon,
            r * sin_lon,
            (n * (1.0 - E2) + self.height) * sin_lat,
        )
    }

    /// Converts from ECEF coordinates, metres, by four iterations of Bowring's formula (1976):
    /// accurate to a micrometre from the deep sea to satellite orbits.
    pub fn from_ecef(x: &Vector3<f64>) -> Self {
        let p = x.x.hypot(x.y);
        let b = A * (1.0 - F);
        let second = E2 / (1.0 - E2);
        // Parametric latitude.
        let mut beta = x.z.atan2((1.0 - F) * p);
        let mut latitude = 0.0;
        for _ in 0..4 {
            let (sin, cos) = beta.sin_cos();
            latitude = (x.z + second * b * sin.powi(3)).atan2(p - E2 * A * cos.powi(3));
            beta = ((1.0 - F) * latitude.sin()).atan2(latitude.cos());
        }
        let (sin, cos) = latitude.sin_cos();
        let n = A / (1.0 - E2 * sin * sin).sqrt();
        let height = p * cos + x.z * sin - A * A / n;
        Self {
            longitude: x.y.atan2(x.x).to_degrees(),
            latitude: latitude.to_degrees(),
            height,
        }
    }

    /// Axes of the local frame here: columns east, north and up, unit vectors in ECEF coordinates.
    pub fn east_north_up(self) -> Matrix3<f64> {
        let (sin_lat, cos_lat) = self.latitude.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.longitude.to_radians().sin_cos();
        Matrix3::from_columns(&[
            Vector3::new(-sin_lon, cos_lon, 0.0),
            Vector3::new(-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat),
            Vector3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat),
        ])
    }

    /// Returns how far another place nearby is to the east, to the north and above, metres.
    pub fn offset_to(self, other: Self) -> [f64; 3] {
        let offset = self.east_north_up().transpose() * (other.to_ecef() - self.to_ecef());
        [offset.x, offset.y, offset.z]
    }

    /// Converts from UTM coordinates, metres, by the series of Krüger (1912) to the fourth power of
    /// the third flattening: accurate to 0.1 mm within the zone and its neighbours.
    pub fn from_utm(zone: Zone, easting: f64, northing: f64, height: f64) -> Self {
        let false_northing = if zone.north { 0.0 } else { 10_000_000.0 };
        let unit = K0 * rectifying_radius();
        let xi = (northing - false_northing) / unit;
        let eta = (easting - 500_000.0) / unit;
        let (mut xi0, mut eta0) = (xi, eta);
        for (j, beta) in inverse_series().iter().enumerate() {
            let m = 2.0 * (j as f64 + 1.0);
            xi0 -= beta * (m * xi).sin() * (m * eta).cosh();
            eta0 -= beta * (m * xi).cos() * (m * eta).sinh();
        }
        let chi = (xi0.sin() / eta0.cosh()).asin();
        let latitude: f64 = chi
            + conformal_series()
                .iter()
                .zip(1..)
                .map(|(d, j)| d * (2.0 * f64::from(j) * chi).sin())
                .sum::<f64>();
        let longitude = zone.meridian() + eta0.sinh().atan2(xi0.cos()).to_degrees();
        // Zones 1 and 60 extend across the 180th meridian.
        let longitude = longitude - 360.0 * (longitude / 360.0).round();
        Self {
            longitude,
            latitude: latitude.to_degrees(),
            height,
        }
    }
}

/// Third flattening.
const N: f64 = F / (2.0 - F);

/// Radius of the circle as long as a meridian.
fn rectifying_radius() -> f64 {
    let [n2, n4] = [N * N, N.powi(4)];
    A / (1.0 + N) * (1.0 + n2 / 4.0 + n4 / 64.0)
}

/// Coefficients of the series from the map to the sphere.
fn inverse_series() -> [f64; 4] {
    let [n2, n3, n4] = [N * N, N.powi(3), N.powi(4)];
    [
        N / 2.0 - 2.0 / 3.0 * n2 + 37.0 / 96.0 * n3 - n4 / 360.0,
        n2 / 48.0 + n3 / 15.0 - 437.0 / 1440.0 * n4,
        17.0 / 480.0 * n3 - 37.0 / 840.0 * n4,
        4397.0 / 161_280.0 * n4,
    ]
}

/// Coefficients of the series from conformal to geodetic latitude.
fn conformal_series() -> [f64; 4] {
    let [n2, n3, n4] = [N * N, N.powi(3), N.powi(4)];
    [
        2.0 * N - 2.0 / 3.0 * n2 - 2.0 * n3 + 116.0 / 45.0 * n4,
        7.0 / 3.0 * n2 - 8.0 / 5.0 * n3 - 227.0 / 45.0 * n4,
        56.0 / 15.0 * n3 - 136.0 / 35.0 * n4,
        4279.0 / 630.0 * n4,
    ]
}

/// A UTM zone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Zone {
    /// 1 to 60.
    number: u8,
    /// True on the northern hemisphere, false on the southern.
    north: bool,
}

impl Zone {
    /// Parses a number and a hemisphere, such as `33N`, `33 N` or `18S`.
    pub fn parse(text: &str) -> Option<Self> {
        let text = text.trim();
        let north = match text.chars().last()? {
            'N' | 'n' => true,
            'S' | 's' => false,
            _ => return None,
        };
        let number = text[..text.len() - 1].trim().parse().ok()?;
        (1..=60).contains(&number).then_some(Self { number, north })
    }

    /// The zone of a reference system in metres on WGS 84, ETRS89 or NAD 83, by its EPSG code or
    /// its name in a definition: "EPSG:32633", "WGS 84 / UTM zone 33N".
    pub fn of_reference_system(definition: &str) -> Option<Self> {
        let definition = definition.trim().to_ascii_uppercase();
        if let Some(code) = definition.strip_prefix("EPSG:") {
            return Self::of_code(code.split('+').next()?.trim().parse().ok()?);
        }
        let (datum, zone) = definition.split_once(" / UTM ZONE ")?;
        let datum = datum.rsplit(['"', '\'']).next()?;
        let end = zone.find(['N', 'S'])? + 1;
        // Behind it may be another unit: "(ftUS)".
        let is_whole = zone[end..]
            .chars()
            .next()
            .is_none_or(|c| "\"'+".contains(c));
        let is_known = ["WGS 84", "ETRS89", "NAD83"].contains(&datum);
        (is_known && is_whole).then(|| Self::parse(&zone[..end]))?
    }

    /// The zone of an EPSG code. Neighbouring codes are other projections: 26929 and up are zones
    /// of the State Plane.
    fn of_code(code: u32) -> Option<Self> {
        let (first, north) = match code {
            32_601..=32_660 => (32_600, true),
            32_701..=32_760 => (32_700, false),
            25_828..=25_838 => (25_800, true),
            26_901..=26_923 => (26_900, true),
            _ => return None,
        };
        let number = (code - first) as u8;
        Some(Self { number, north })
    }

    /// Longitude of the central meridian, degrees.
    fn meridian(self) -> f64 {
        6.0 * f64::from(self.number) - 183.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zones_are_those_of_reference_systems() {
        let zone = |text| Zone::of_reference_system(text);
        for text in [
            "EPSG:32633",
            "epsg:25833+5773",
            "PROJCS[\"WGS 84 / UTM zone 33N\",...",
        ] {
            assert_eq!(zone(text), Zone::parse("33N"), "{text}");
        }
        assert_eq!(zone("EPSG:32718"), Zone::parse("18S"));
        for text in [
            "EPSG:4326",
            "EPSG:32661",
            "EPSG:2154",
            // California in the State Plane, another datum, and feet.
            "EPSG:26943",
            "ED50 / UTM zone 31N",
            "NAD83 / UTM zone 10N (ftUS)",
            "Local",
            "UTM zone N",
        ] {
            assert_eq!(zone(text), None, "{text}");
        }
    }

    #[test]
    fn ecef_coordinates_round_trip() {
        for latitude in [-89.9, -45.0, -0.1, 0.0, 30.0, 57.3, 90.0] {
            for (longitude, height) in [(-179.5, -4000.0), (0.0, 0.0), (98.0, 12_000.0)] {
                let place = Geodetic {
                    longitude,
                    latitude,
                    height,
                };
                let back = Geodetic::from_ecef(&place.to_ecef());
                assert!(
                    (back.to_ecef() - place.to_ecef()).norm() < 1e-6,
                    "{place:?} {back:?}"
                );
            }
        }
        // On the equator and at the pole the distance is that semi-axis.
        assert!(
            (Geodetic {
                longitude: 90.0,
                latitude: 0.0,
                height: 7.0
            }
            .to_ecef()
            .y - A
                - 7.0)
                .abs()
                < 1e-6
        );
        assert!(
            (Geodetic {
                longitude: 0.0,
                latitude: 90.0,
                height: 0.0
            }
            .to_ecef()
            .z - 6_356_752.314_245)
                .abs()
                < 1e-5
        );
    }

    /// On the central meridian a metre along an axis of UTM is 1 m / 0.9996 on the ground; the axes
    /// are perpendicular everywhere.
    #[test]
    fn utm_is_conformal_with_the_documented_scale() {
        let zone = Zone::parse("33N").unwrap();
        let at = |east: f64, north: f64| Geodetic::from_utm(zone, east, north, 0.0).to_ecef();
        for (east, north) in [
            (500_000.0, 5_400_000.0),
            (690_000.0, 5_400_000.0),
            (500_000.0, 100_000.0),
        ] {
            let right = at(east + 1.0, north) - at(east - 1.0, north);
            let ahead = at(east, north + 1.0) - at(east, north - 1.0);
            let scale = K0 * (1.0 + ((east - 500_000.0) / 6_378_000.0f64).powi(2) / 2.0);
            assert!(
                (2.0 / right.norm() - scale).abs() < 1e-5
                    && (2.0 / ahead.norm() - scale).abs() < 1e-5
            );
            assert!(right.normalize().dot(&ahead.normalize()).abs() < 1e-7);
        }
        let middle = Geodetic::from_utm(zone, 500_000.0, 0.0, 3.0);
        assert!((middle.longitude - 15.0).abs() < 1e-12 && middle.latitude.abs() < 1e-12);
        // The distance from the equator to a pole along a meridian is 10,001,965.729 m.
        let pole = Geodetic::from_utm(zone, 500_000.0, K0 * 10_001_965.729, 0.0);
        assert!((pole.latitude - 90.0).abs() < 1e-8, "{pole:?}");
        let south = Geodetic::from_utm(Zone::parse("33 S").unwrap(), 500_000.0, 10_000_000.0, 0.0);
        assert!(south.latitude.abs() < 1e-12);
    }

    #[test]
    fn longitudes_are_wrapped_at_180_degrees() {
        let at = |zone: &str, easting: f64| {
            Geodetic::from_utm(Zone::parse(zone).unwrap(), easting, 8_000_000.0, 0.0)
        };
        for (zone, neighbour, easting) in [("60S", "1S", 850_000.0), ("1S", "60S", 150_000.0)] {
            let place = at(zone, easting);
            assert!((-180.0..=180.0).contains(&place.longitude), "{place:?}");
            let mirrored = at(neighbour, 1_000_000.0 - easting);
            assert!(
                (place.longitude + mirrored.longitude).abs() < 1e-9,
                "{place:?} {mirrored:?}"
            );
        }
    }

    #[test]
    fn zones_are_numbers_with_a_hemisphere() {
        assert_eq!(Zone::parse("33N").unwrap().meridian(), 15.0);
        assert!(
            ["", "N", "0N", "61S", "33", "33X", "-1N"]
                .iter()
                .all(|text| Zone::parse(text).is_none())
        );
    }
}
