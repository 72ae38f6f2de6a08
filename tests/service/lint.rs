//! The rules of buf's STANDARD category that a descriptor can break, checked without buf.

use std::collections::BTreeSet;

use lookalike::service::proto::DESCRIPTORS;
use prost::Message;
use prost_types::{
    DescriptorProto, EnumDescriptorProto, FileDescriptorProto, FileDescriptorSet,
    ServiceDescriptorProto,
};

fn files() -> Vec<FileDescriptorProto> {
    let files = FileDescriptorSet::decode(DESCRIPTORS).unwrap().file;
    files.into_iter().filter(|file| file.name().starts_with("lookalike/")).collect()
}

/// `JobState` to `JOB_STATE`.
fn upper_snake(name: &str) -> String {
    let mut snake = String::new();
    for (i, c) in name.char_indices() {
        if c.is_uppercase() && i > 0 {
            snake.push('_');
        }
        snake.extend(c.to_uppercase());
    }
    snake
}

fn is_lower_snake(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    name.chars().all(allowed) && !name.contains("__") && !name.starts_with('_')
}

fn is_pascal(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_uppercase()) && !name.contains('_')
}

#[test]
fn packages_are_versioned_and_match_their_folders() {
    let files = files();
    assert_eq!(files.len(), 5);
    for file in files {
        let (folder, name) = file.name().rsplit_once('/').unwrap();
        assert_eq!(folder.replace('/', "."), file.package());
        assert!(file.package().rsplit('.').next() == Some("v1"), "{}", file.package());
        assert!(is_lower_snake(name.strip_suffix(".proto").unwrap()), "{name}");
        assert_eq!(file.syntax(), "proto3");
        assert!(file.public_dependency.is_empty() && file.weak_dependency.is_empty());
    }
}

#[test]
fn names_follow_the_style() {
    for file in files() {
        file.message_type.iter().for_each(check_message);
        file.enum_type.iter().for_each(check_enum);
    }
}

fn check_message(message: &DescriptorProto) {
    assert!(is_pascal(message.name()), "{}", message.name());
    for field in &message.field {
        assert!(is_lower_snake(field.name()), "{}.{}", message.name(), field.name());
    }
    // A proto3 `optional` field is a oneof of its own whose name begins with an underscore.
    for oneof in message.oneof_decl.iter().filter(|oneof| !oneof.name().starts_with('_')) {
        assert!(is_lower_snake(oneof.name()), "{}.{}", message.name(), oneof.name());
    }
    message.nested_type.iter().for_each(check_message);
    message.enum_type.iter().for_each(check_enum);
}

fn check_enum(words: &EnumDescriptorProto) {
    assert!(is_pascal(words.name()), "{}", words.name());
    let prefix = format!("{}_", upper_snake(words.name()));
    assert_eq!(words.value[0].number(), 0);
    assert_eq!(words.value[0].name(), format!("{prefix}UNSPECIFIED"));
    for value in &words.value {
        assert!(value.name().starts_with(&prefix), "{}", value.name());
    }
}

#[test]
fn every_method_has_messages_of_its_own() {
    let mut seen = BTreeSet::new();
    for file in files() {
        for service in &file.service {
            check_service(&format!(".{}.", file.package()), service, &mut seen);
        }
    }
    assert_eq!(seen.len(), 2 * (15 + 9));
}

fn check_service(package: &str, service: &ServiceDescriptorProto, seen: &mut BTreeSet<String>) {
    assert!(service.name().ends_with("Service"), "{}", service.name());
    for method in &service.method {
        assert!(is_pascal(method.name()));
        assert_eq!(method.input_type(), format!("{package}{}Request", method.name()));
        assert_eq!(method.output_type(), format!("{package}{}Response", method.name()));
        assert!(
            seen.insert(method.input_type().into()) && seen.insert(method.output_type().into())
        );
    }
}

#[test]
fn every_import_is_used() {
    for file in files() {
        let uses = format!("{file:?}");
        for import in &file.dependency {
            let package = import.rsplit_once('/').unwrap().0.replace('/', ".");
            let used = uses.contains(&format!("\".{package}.")) || file.package() == package;
            assert!(used, "{} imports {import} for nothing", file.name());
        }
    }
}
