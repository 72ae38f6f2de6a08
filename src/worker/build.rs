//! Which build of the program this is: only the same one asks the same questions in the same order, and so can go on
//! from a checkpoint.

use std::{fs::File, sync::OnceLock};

/// BLAKE3 of the executable, lower-case hexadecimal; empty where it cannot be read: it goes on from no checkpoint.
pub(super) fn build() -> &'static str {
    static BUILD: OnceLock<String> = OnceLock::new();
    BUILD.get_or_init(|| {
        let hash = || {
            // The file that runs, even where another was put in its place.
            let mut hasher = blake3::Hasher::new();
            hasher.update_reader(File::open("/proc/self/exe")?)?;
            Ok::<_, std::io::Error>(hasher.finalize().to_hex().to_string())
        };
        hash().unwrap_or_default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_build_has_a_name() {
        assert_eq!(build().len(), 64);
    }
}
