//! NumPy views of the library's tables.

use bytemuck::Pod;
use numpy::{
    Element, PyArray1, PyArray2, PyArrayMethods, PyUntypedArray,
    ndarray::{ArrayView1, ArrayView2},
};
use pyo3::{PyClass, prelude::*};

/// A read-only view of `values` that keeps `owner` alive.
///
/// `owner` must be the Python object that holds the value behind `values`.
pub fn view<'py, T: Element>(
    owner: &Bound<'py, impl PyClass>,
    values: &[T],
) -> PyResult<Bound<'py, PyUntypedArray>> {
    // SAFETY: the classes of this crate are frozen and hold their values in an `Arc` that nothing
    // changes, so that the slice lives, unmoved and unchanged, as long as `owner`, which the array
    // keeps alive; the array is made read-only.
    let array =
        unsafe { PyArray1::borrow_from_array(&ArrayView1::from(values), owner.clone().into_any()) };
    read_only(array.as_untyped().clone())
}

/// The same in rows of `columns` numbers; `values` must be whole rows.
pub fn rows<'py, T: Element + Pod>(
    owner: &Bound<'py, impl PyClass>,
    values: &[impl Pod],
    columns: usize,
) -> PyResult<Bound<'py, PyUntypedArray>> {
    let values: &[T] = bytemuck::cast_slice(values);
    let rows =
        ArrayView2::from_shape((values.len() / columns, columns), values).expect("whole rows");
    // SAFETY: as in `view`.
    let array = unsafe { PyArray2::borrow_from_array(&rows, owner.clone().into_any()) };
    read_only(array.as_untyped().clone())
}

fn read_only(array: Bound<'_, PyUntypedArray>) -> PyResult<Bound<'_, PyUntypedArray>> {
    array.getattr("flags")?.setattr("writeable", false)?;
    Ok(array)
}
