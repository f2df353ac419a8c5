"""Pictures of the light, the faces and the rays of a lens, and the jobs that draw them."""
