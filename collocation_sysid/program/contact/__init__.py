"""Contact during a motion: `step_contact` limits the steps of Newton's method by the contact, and
`contact_summary` describes the contact of a solved motion. The contact law is `model.contact`.
"""
