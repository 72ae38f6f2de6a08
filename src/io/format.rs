//! Which reader a file gets: a table of formats, each with its extensions and a test of content.

use super::{
    IoError, archive, gltf, obj, ply,
    soup::Soup,
    source::{Source, without_mark},
    stl,
};

/// One row of the table.
pub(super) struct Format {
    pub(super) name: &'static str,
    extensions: &'static [&'static str],
    /// How sure the test of content is: a strong one decides against the extension.
    strong: bool,
    looks_like: fn(&[u8]) -> bool,
    /// Whether what no test of content knows may be of this format where the extension says so.
    may_be: fn(&[u8]) -> bool,
    pub(super) read: for<'a> fn(&Source<'a>) -> Result<Soup, IoError>,
}

/// In the order in which content is tried.
static FORMATS: [Format; 6] = [
    Format {
        name: "GLB",
        extensions: &["glb"],
        strong: true,
        looks_like: |b| b.starts_with(b"glTF"),
        may_be: never,
        read: gltf::read_glb,
    },
    Format {
        name: "ZIP",
        extensions: &["zip"],
        strong: true,
        looks_like: |b| b.starts_with(b"PK\x03\x04") || b.starts_with(b"PK\x05\x06"),
        may_be: never,
        read: archive::read,
    },
    Format {
        name: "PLY",
        extensions: &["ply"],
        strong: true,
        looks_like: |b| b.starts_with(b"ply\n") || b.starts_with(b"ply\r"),
        may_be: never,
        read: ply::read,
    },
    Format {
        name: "STL",
        extensions: &["stl"],
        strong: true,
        looks_like: stl::looks_like,
        may_be: stl::may_be,
        read: stl::read,
    },
    Format {
        name: "glTF",
        extensions: &["gltf"],
        strong: true,
        looks_like: looks_like_json,
        may_be: never,
        read: gltf::read_gltf,
    },
    Format {
        name: "OBJ",
        extensions: &["obj"],
        strong: false,
        looks_like: looks_like_text,
        may_be: never,
        read: obj::read,
    },
];

impl Format {
    /// Whether the name ends with one of the format's extensions.
    pub(super) fn has_extension_of(&self, file: &str) -> bool {
        extension(file).is_some_and(|e| self.extensions.iter().any(|x| e.eq_ignore_ascii_case(x)))
    }
}

/// Whether the name is that of a model, archives aside.
pub(super) fn is_model(file: &str) -> bool {
    FORMATS.iter().any(|f| f.name != "ZIP" && f.has_extension_of(file))
}

/// The format by extension if the content agrees, else the one whose content test is sure, else that by extension
/// if it may be.
pub(super) fn detect(source: &Source<'_>) -> Result<&'static Format, IoError> {
    let named = FORMATS.iter().find(|f| f.has_extension_of(source.file));
    if let Some(format) = named.filter(|f| (f.looks_like)(source.bytes)) {
        return Ok(format);
    }
    if let Some(format) = FORMATS.iter().find(|f| f.strong && (f.looks_like)(source.bytes)) {
        return Ok(format);
    }
    if let Some(format) = named.filter(|f| (f.may_be)(source.bytes)) {
        return Ok(format);
    }
    let begins = source.bytes[..source.bytes.len().min(12)].escape_ascii().to_string();
    let problem = match named {
        Some(f) => format!("not a {} file: it begins with '{begins}'", f.name),
        None => format!("unknown format: it begins with '{begins}'"),
    };
    Err(IoError::UnknownFormat { file: source.file.to_owned(), problem })
}

fn extension(file: &str) -> Option<&str> {
    file.rsplit(['/', '\\']).next()?.rsplit_once('.').map(|(_, e)| e)
}

fn never(_: &[u8]) -> bool {
    false
}

fn looks_like_json(bytes: &[u8]) -> bool {
    without_mark(bytes).iter().find(|b| !b.is_ascii_whitespace()) == Some(&b'{')
}

fn looks_like_text(bytes: &[u8]) -> bool {
    !bytes[..bytes.len().min(4096)].contains(&0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::Limits;

    fn name_of(file: &str, bytes: &[u8]) -> Result<&'static str, IoError> {
        detect(&Source { file, bytes, limits: &Limits::default(), beside: None }).map(|f| f.name)
    }

    #[test]
    fn content_decides_where_it_is_sure() {
        assert_eq!(name_of("a.b/x.GLB", b"glTF...").unwrap(), "GLB");
        assert_eq!(name_of("x.obj", b"ply\nformat").unwrap(), "OBJ", "text may be OBJ");
        assert_eq!(name_of("x.stl", b"ply\nformat").unwrap(), "PLY");
        assert_eq!(name_of("x", b"PK\x03\x04").unwrap(), "ZIP");
        assert_eq!(name_of("x", b" {}").unwrap(), "glTF");
        let error = name_of("x.glb", b"hello").unwrap_err();
        assert!(error.to_string().contains("not a GLB file: it begins with 'hello'"), "{error}");
        assert_eq!(name_of("x", b"v 0 0 0").unwrap_err().code(), "UNKNOWN_FORMAT");
    }
}
