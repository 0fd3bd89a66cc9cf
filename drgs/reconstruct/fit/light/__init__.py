"""Light while it is fitted: the learned table, split sum, and what the object itself blocks and sends back."""
