//! memoryless
