"""The error models that ship in ``assets/pem``, fitted from the development data."""
