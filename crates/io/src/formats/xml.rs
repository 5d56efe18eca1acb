//! Pull reader for XML: a reader walks down to the records and takes them one after another, so a
//! file of any size needs the memory of one record, which is bounded: what readers keep of records
//! are values, not elements.

use std::borrow::Cow;

use quick_xml::{
    Reader, XmlVersion,
    escape::resolve_predefined_entity,
    events::{BytesRef, BytesStart, Event},
};

use super::{Fault, Place, Problem, words::parse};

/// Deepest nesting of elements, and most elements and attributes in one record.
const DEEPEST: usize = 64;
const MOST_PARTS: usize = 1 << 16;
/// Most attributes of an element.
const MOST_ATTRIBUTES: usize = 1 << 10;

/// An element with all that it contains.
#[derive(Debug)]
pub struct Element {
    pub name: String,
    attributes: Vec<(String, String)>,
    text: String,
    children: Vec<Element>,
    at: Place,
}

impl Element {
    pub fn at(&self) -> Place {
        self.at
    }

    pub fn attribute(&self, name: &str) -> Option<&str> {
        self.attributes
            .iter()
            .find(|(known, _)| known == name)
            .map(|(_, value)| &**value)
    }

    /// The text, trimmed.
    pub fn text(&self) -> &str {
        self.text.trim()
    }

    /// The first child of this name.
    pub fn child(&self, name: &str) -> Option<&Element> {
        self.children.iter().find(|child| child.name == name)
    }

    /// The first child of this name, which must be there.
    pub fn required_child(&self, name: &'static str) -> Result<&Element, Fault> {
        self.child(name).ok_or_else(|| self.lacks(name))
    }

    pub fn children<'a>(&'a self, name: &'a str) -> impl Iterator<Item = &'a Element> {
        self.children.iter().filter(move |child| child.name == name)
    }

    /// All numbers of the text.
    pub fn numbers<const N: usize>(&self) -> Result<[f64; N], Fault> {
        // One more than wanted shows a surplus; the text may have millions.
        let words = self.text.split_ascii_whitespace().take(N + 1);
        let values: Option<Vec<f64>> = words.map(|word| parse(word.as_bytes()).ok()).collect();
        values
            .and_then(|values| values.try_into().ok())
            .ok_or_else(|| {
                let found: String = self.text().chars().take(40).collect();
                let fault = Problem::syntax("numbers", found).at(self.at);
                fault.in_record(|| format!("<{}>", self.name))
            })
    }

    /// The number in a child, if there is one.
    pub fn number(&self, child: &str) -> Result<Option<f64>, Fault> {
        self.child(child)
            .map(|child| child.numbers::<1>().map(|[value]| value))
            .transpose()
    }

    /// The numbers in children, all of which must be there.
    pub fn required<const N: usize>(&self, children: [&'static str; N]) -> Result<[f64; N], Fault> {
        let mut values = [0.0; N];
        for (value, name) in values.iter_mut().zip(children) {
            *value = self.number(name)?.ok_or_else(|| self.lacks(name))?;
        }
        Ok(values)
    }

    /// The fault of an element that has no such child.
    pub fn lacks(&self, child: &'static str) -> Fault {
        let found = format!("<{}> without it", self.name);
        Problem::syntax(child, found).at(self.at)
    }
}

/// The unread part of a file.
pub struct Xml<'a> {
    reader: Reader<&'a [u8]>,
    open: usize,
}

impl<'a> Xml<'a> {
    pub fn new(bytes: &'a [u8]) -> Result<Self, Fault> {
        let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        let text = std::str::from_utf8(bytes).map_err(|error| {
            let at = Place::Byte(error.valid_up_to() as u64);
            Problem::syntax("text in UTF-8", "other bytes").at(at)
        })?;
        let mut reader = Reader::from_str(text);
        reader.config_mut().expand_empty_elements = true;
        Ok(Self { reader, open: 0 })
    }

    /// Walks into the root, which must have this name; `expected` describes it.
    pub fn in_root(bytes: &'a [u8], name: &str, expected: &'static str) -> Result<Self, Fault> {
        let mut xml = Self::new(bytes)?;
        match xml.enter()? {
            Some(root) if root.name == name => Ok(xml),
            root => {
                let found = root.map_or("nothing".into(), |root| format!("<{}>", root.name));
                Err(Problem::Syntax { expected, found }.at(Place::File))
            }
        }
    }

    /// Walks into the next child of the element that was entered last, which is returned without
    /// what it contains; leaves the element and returns `None` if there is no other. At first, the
    /// root is the only child.
    pub fn enter(&mut self) -> Result<Option<Element>, Fault> {
        loop {
            match self.step()? {
                Step::Into(element) => return Ok(Some(element)),
                Step::Out => return Ok(None),
                Step::Text(_) => {}
            }
        }
    }

    /// Reads all that the entered element contains, and leaves it.
    pub fn whole(&mut self, entered: Element) -> Result<Element, Fault> {
        let mut room = MOST_PARTS;
        self.fill(entered, &mut room)
    }

    /// Leaves the entered element; nothing of what it contains is kept or looked at.
    pub fn skip(&mut self) -> Result<(), Fault> {
        let inside = self.open;
        while self.open >= inside {
            let at = self.place();
            let event = self.reader.read_event();
            match event.map_err(|error| broken(at, &error))? {
                Event::Start(_) => self.open(at)?,
                Event::End(_) => self.open -= 1,
                Event::Eof => return Err(Problem::Truncated("an element").at(at)),
                _ => {}
            }
        }
        Ok(())
    }

    fn fill(&mut self, mut element: Element, room: &mut usize) -> Result<Element, Fault> {
        loop {
            match self.step()? {
                Step::Into(child) => {
                    let full =
                        || format!("a record of more than {MOST_PARTS} elements and attributes");
                    *room = room
                        .checked_sub(1 + child.attributes.len())
                        .ok_or_else(|| Problem::Content(full()).at(child.at))?;
                    // The recursion ends: `open` refuses elements that are nested too deeply.
                    let child = self.fill(child, room)?;
                    element.children.push(child);
                }
                Step::Text(text) => element.text += &text,
                Step::Out => return Ok(element),
            }
        }
    }

    fn step(&mut self) -> Result<Step<'a>, Fault> {
        loop {
            let at = self.place();
            let event = self
                .reader
                .read_event()
                .map_err(|error| broken(at, &error))?;
            return Ok(match event {
                Event::Start(start) => Step::Into(self.start(&start, at)?),
                Event::Eof if self.open > 0 => {
                    return Err(Problem::Truncated("an element").at(at));
                }
                Event::End(_) | Event::Eof => {
                    // Past the end of the file nothing is open, and 0 - 1 would overflow.
                    self.open = self.open.saturating_sub(1);
                    Step::Out
                }
                Event::Text(text) => Step::Text(text.xml10_content()),
                Event::CData(text) => Step::Text(text.xml10_content()),
                Event::GeneralRef(name) => Step::Text(Cow::Owned(character_of(&name, at)?)),
                _ => continue,
            });
        }
    }

    /// Counts an element that begins.
    fn open(&mut self, at: Place) -> Result<(), Fault> {
        self.open += 1;
        if self.open <= DEEPEST {
            return Ok(());
        }
        let deeper = format!("elements are nested deeper than {DEEPEST}");
        Err(Problem::Content(deeper).at(at))
    }

    fn start(&mut self, start: &BytesStart, at: Place) -> Result<Element, Fault> {
        self.open(at)?;
        let mut attributes = Vec::new();
        // Without the search for repeated names, which takes the square of their number.
        let mut all = start.attributes();
        all.with_checks(false);
        for attribute in all {
            if attributes.len() == MOST_ATTRIBUTES {
                return Err(
                    Problem::Content(format!("more than {MOST_ATTRIBUTES} attributes")).at(at),
                );
            }
            let attribute = attribute.map_err(|error| broken(at, &error))?;
            let value = attribute
                .normalized_value(XmlVersion::Implicit1_0)
                .map_err(|error| broken(at, &error))?;
            attributes.push((attribute.key.0.to_owned(), value.into_owned()));
        }
        let name = start.local_name().into_inner().to_owned();
        Ok(Element {
            name,
            attributes,
            text: String::new(),
            children: Vec::new(),
            at,
        })
    }

    fn place(&self) -> Place {
        Place::Byte(self.reader.buffer_position())
    }
}

enum Step<'a> {
    Into(Element),
    Text(Cow<'a, str>),
    Out,
}

/// The text of a character reference or of one of XML's own entities.
fn character_of(name: &BytesRef, at: Place) -> Result<String, Fault> {
    let by_number = name
        .resolve_char_ref()
        .map_err(|error| broken(at, &error))?;
    let by_number = by_number.map(String::from);
    let text = by_number.or_else(|| resolve_predefined_entity(name).map(String::from));
    text.ok_or_else(|| {
        let unknown = format!("an entity that is no character: &{};", &**name);
        Problem::Content(unknown).at(at)
    })
}

fn broken(at: Place, error: &dyn std::error::Error) -> Fault {
    Problem::Content(format!("not well-formed XML: {error}")).at(at)
}
