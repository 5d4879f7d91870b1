//! Tables for other programs: Parquet, a column an attribute, as pandas and DuckDB read it.

use std::sync::Arc;

use parquet::basic::{ConvertedType, Repetition, Type as Physical};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::Type;

/// A column of one kind; all of a table are equally long.
#[derive(Debug, Clone)]
pub enum Column {
    /// UTF-8.
    Text(Vec<String>),
    /// Whole numbers.
    Whole(Vec<i64>),
    /// Numbers; NaN where there is none.
    Real(Vec<f64>),
}

impl Column {
    fn schema(&self, name: &str) -> Result<Type, ParquetError> {
        let (physical, converted) = match self {
            Self::Text(_) => (Physical::BYTE_ARRAY, ConvertedType::UTF8),
            Self::Whole(_) => (Physical::INT64, ConvertedType::NONE),
            Self::Real(_) => (Physical::DOUBLE, ConvertedType::NONE),
        };
        let builder =
            Type::primitive_type_builder(name, physical).with_repetition(Repetition::REQUIRED);

        builder.with_converted_type(converted).build()
    }
}

/// A Parquet file of columns in their order.
///
/// # Errors
/// What the library says, in words.
pub fn parquet_file(columns: &[(&str, Column)]) -> Result<Vec<u8>, String> {
    written(columns).map_err(|error| error.to_string())
}

fn written(columns: &[(&str, Column)]) -> Result<Vec<u8>, ParquetError> {
    let mut fields = Vec::with_capacity(columns.len());
    for (name, column) in columns {
        fields.push(Arc::new(column.schema(name)?));
    }

    let schema = Arc::new(
        Type::group_type_builder("runs")
            .with_fields(fields)
            .build()?,
    );

    let mut file = Vec::new();
    let mut writer = SerializedFileWriter::new(
        &mut file,
        schema,
        Arc::new(WriterProperties::builder().build()),
    )?;
    let mut group = writer.next_row_group()?;

    for (_, column) in columns {
        let Some(mut into) = group.next_column()? else {
            break;
        };
        match column {
            Column::Text(values) => {
                let values: Vec<ByteArray> =
                    values.iter().map(|value| value.as_str().into()).collect();
                into.typed::<ByteArrayType>()
                    .write_batch(&values, None, None)?;
            }
            Column::Whole(values) => {
                into.typed::<Int64Type>().write_batch(values, None, None)?;
            }
            Column::Real(values) => {
                into.typed::<DoubleType>().write_batch(values, None, None)?;
            }
        }

        into.close()?;
    }

    group.close()?;
    writer.close()?;

    Ok(file)
}
