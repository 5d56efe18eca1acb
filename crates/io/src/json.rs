//! Faults of JSON in plain words: serde's speak of the types of a program.

use std::borrow::Cow;

use viewrank_core::base::error::shortened;

/// Says where in a file JSON is not what it should be, and how: `line 3, "views[2].pose": ...`.
pub fn place_and_fault(error: &serde_json::Error, bytes: &[u8]) -> String {
    // Errors without a place have line 0.
    format!("line {}, {}", error.line().max(1), fault(error, bytes))
}

/// Says which value of JSON is not what it should be, and how.
pub fn fault(error: &serde_json::Error, bytes: &[u8]) -> String {
    let text = error.to_string();
    // Serde appends the place, which callers say in their own way.
    let at = format!(" at line {} column {}", error.line(), error.column());
    let what = in_words(text.strip_suffix(&at).unwrap_or(&text));
    match &*path_to(read_until(error, bytes)) {
        "" => what,
        path => format!("\"{}\": {what}", shortened(path)),
    }
}

fn in_words(text: &str) -> String {
    let kinds = ["invalid type: ", "invalid value: ", "invalid length "];
    let wrong = kinds.iter().find_map(|kind| text.strip_prefix(kind));
    if let Some((found, expected)) = wrong.and_then(|wrong| wrong.split_once(", expected ")) {
        let limit = text
            .starts_with("invalid value")
            .then(|| most(expected))
            .flatten();
        let limit = limit.map_or_else(String::new, |most| format!(" to {most}"));
        return format!(
            "{} where {}{limit} is expected",
            value(found),
            kind(expected)
        );
    }
    let field = |start| text.strip_prefix(start)?.strip_suffix('`');
    if let Some(field) = field("missing field `") {
        return format!("\"{field}\" is missing");
    }
    if let Some(field) = field("duplicate field `") {
        return format!("\"{field}\" is there twice");
    }
    match text {
        _ if text.starts_with("EOF while parsing") => "the JSON ends early".into(),
        "expected value" => "not JSON".into(),
        "trailing characters" => "text after the end of the JSON".into(),
        "recursion limit exceeded" => "lists or objects nested too deeply".into(),
        _ => text.into(),
    }
}

/// A value, as serde names it.
fn value(found: &str) -> Cow<'_, str> {
    let of_kind = |kind| found.strip_prefix(kind);
    let quoted = |text: &str| shortened(text.trim_matches('`')).into_owned();
    if let Some(number) = of_kind("integer ").or_else(|| of_kind("floating point ")) {
        return format!("the number {}", quoted(number)).into();
    }
    if let Some(text) = of_kind("string ") {
        return format!("the text {}", quoted(text)).into();
    }
    if let Some(word) = of_kind("boolean ") {
        return quoted(word).into();
    }
    match found {
        "map" => "an object".into(),
        "sequence" => "a list".into(),
        "unit value" => "null".into(),
        // Of a wrong length, serde says the number alone.
        _ if found.bytes().all(|byte| byte.is_ascii_digit()) => format!("a list of {found}").into(),
        _ => found.into(),
    }
}

/// What is expected, as serde names it.
fn kind(expected: &str) -> Cow<'_, str> {
    let lists = ["an array of length ", "a tuple of size "];
    if let Some(length) = lists.iter().find_map(|list| expected.strip_prefix(list)) {
        return format!("a list of {length}").into();
    }
    match expected {
        "f32" | "f64" => "a number".into(),
        "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number from 0 up".into(),
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number".into(),
        "a string" | "a borrowed string" | "string" => "a text".into(),
        "a boolean" => "true or false".into(),
        "a sequence" => "a list".into(),
        "a map" => "an object".into(),
        _ if expected.starts_with("struct ") => "an object".into(),
        _ if expected.starts_with("tuple struct ") => "a list".into(),
        _ => expected.into(),
    }
}

/// The greatest number that fits, as serde names what is expected.
fn most(expected: &str) -> Option<u64> {
    match expected {
        "u8" => Some(u8::MAX.into()),
        "u16" => Some(u16::MAX.into()),
        "u32" => Some(u32::MAX.into()),
        "u64" | "usize" => Some(u64::MAX),
        _ => None,
    }
}

/// What was read when the fault was found.
fn read_until<'a>(error: &serde_json::Error, bytes: &'a [u8]) -> &'a [u8] {
    let lines = bytes.split_inclusive(|byte| *byte == b'\n');
    let above = lines.take(error.line().saturating_sub(1)).map(<[u8]>::len);
    let end = above.sum::<usize>().saturating_add(error.column());
    &bytes[..end.min(bytes.len())]
}

/// Bytes of a name that are shown.
const LONGEST_NAME: usize = 100;

/// A step to a value: the name in an object, or the number in a list.
enum Step {
    Name(String),
    Number(usize),
}

/// Steps of a way that are shown.
const MOST_STEPS: usize = 16;

/// The way to the value at the end of the start of a file, such as `frames[2].file_path`, or its
/// begin.
fn path_to(start: &[u8]) -> String {
    let (mut steps, mut text): (Vec<Step>, &[u8]) = (Vec::new(), &[]);
    // Steps behind those.
    let mut deeper: usize = 0;
    let mut at = 0;
    while let Some(byte) = start.get(at) {
        at += 1;
        match byte {
            b'"' => {
                let begin = at;
                while start.get(at).is_some_and(|byte| *byte != b'"') {
                    // An escaped quote does not end the text.
                    at += if start[at] == b'\\' { 2 } else { 1 };
                }
                text = &start[begin..at.min(begin + LONGEST_NAME).min(start.len())];
                at += 1;
            }
            b'{' | b'[' if steps.len() == MOST_STEPS => deeper += 1,
            b'}' | b']' if deeper > 0 => deeper -= 1,
            _ if deeper > 0 => {}
            b'{' => steps.push(Step::Name(String::new())),
            b'[' => steps.push(Step::Number(0)),
            b'}' | b']' => drop(steps.pop()),
            b':' => {
                if let Some(Step::Name(name)) = steps.last_mut() {
                    *name = String::from_utf8_lossy(text).into_owned();
                }
            }
            b',' => match steps.last_mut() {
                Some(Step::Number(n)) => *n += 1,
                Some(Step::Name(name)) => name.clear(),
                None => {}
            },
            _ => {}
        }
    }
    let mut path = String::new();
    for step in steps {
        match step {
            Step::Number(n) => path += &format!("[{n}]"),
            Step::Name(name) if path.is_empty() || name.is_empty() => path += &name,
            Step::Name(name) => path += &format!(".{name}"),
        }
    }
    path
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use serde::{Deserialize, de::DeserializeOwned};

    use super::*;

    #[expect(dead_code, reason = "only its faults are read")]
    #[derive(Deserialize)]
    struct Model {
        views: Vec<View>,
        name: Option<String>,
        origin: Option<[f64; 3]>,
        ids: Option<BTreeMap<String, u32>>,
    }

    #[expect(dead_code, reason = "only its faults are read")]
    #[derive(Deserialize)]
    struct View {
        x: f64,
        is_on: Option<bool>,
    }

    fn said<T: DeserializeOwned>(text: &str) -> String {
        let error = serde_json::from_str::<T>(text).err().unwrap();
        place_and_fault(&error, text.as_bytes())
    }

    #[test]
    fn faults_name_the_value_and_speak_of_json() {
        for (text, expected) in [
            (
                r#"{"views":3}"#,
                r#"line 1, "views": the number 3 where a list is expected"#,
            ),
            (
                r#"{"views":{"x":1}}"#,
                r#"line 1, "views": an object where a list is expected"#,
            ),
            (
                r#"{"views":[{"x":1},4]}"#,
                r#"line 1, "views[1]": the number 4 where an object is expected"#,
            ),
            (
                "{\"views\":[\n{\"x\":\n\"a:b,\"}]}",
                r#"line 3, "views[0].x": the text "a:b," where a number is expected"#,
            ),
            (
                r#"{"views":[{"x":null}]}"#,
                r#"line 1, "views[0].x": null where a number is expected"#,
            ),
            (
                r#"{"views":[{"x":1,"is_on":[]}]}"#,
                r#"line 1, "views[0].is_on": a list where true or false is expected"#,
            ),
            (r#"{"views":[{}]}"#, r#"line 1, "views[0]": "x" is missing"#),
            (
                r#"{"views":[],"views":[]}"#,
                r#"line 1, "views" is there twice"#,
            ),
            (
                r#"{"views":[],"name":7}"#,
                r#"line 1, "name": the number 7 where a text is expected"#,
            ),
            (
                r#"{"views":[],"origin":[1,2]}"#,
                r#"line 1, "origin": a list of 2 where a list of 3 is expected"#,
            ),
            (
                r#"{"views":[],"ids":{"a":-1.5}}"#,
                r#"line 1, "ids.a": the number -1.5 where a whole number from 0 up is expected"#,
            ),
            (
                r#"{"views":[],"ids":{"a":5000000000}}"#,
                r#"line 1, "ids.a": the number 5000000000 where a whole number from 0 up to 4294967295 is expected"#,
            ),
            ("7", "line 1, the number 7 where an object is expected"),
            ("", "line 1, the JSON ends early"),
            ("<xml>", "line 1, not JSON"),
            (r#"{"views":[]}x"#, "line 1, text after the end of the JSON"),
        ] {
            assert_eq!(said::<Model>(text), expected, "{text}");
        }
    }

    #[test]
    fn of_a_long_way_to_a_fault_the_begin_is_shown() {
        let deep = format!(r#"{{"views":[],"y":{}"#, "[".repeat(1_000_000));
        assert_eq!(path_to(deep.as_bytes()), format!("y{}", "[0]".repeat(15)));
        let closed = format!(
            r#"{{"y":{}{},"views":7}}"#,
            "[".repeat(100),
            "]".repeat(100)
        );
        assert!(said::<Model>(&closed).contains(r#""views": the number 7"#));
    }

    #[test]
    fn the_way_to_a_fault_ends_with_the_bytes() {
        for cut in ["{\"a\":\"\\", "{\"a", "[[[", "]}", "\"\\\"", "{\"\\ud8"] {
            said::<Model>(cut);
        }
    }
}
